from __future__ import annotations

import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, small_encoder
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv

from crptpro.transforms import FrozenEncoder


def images(*lead):
    return torch.randint(0, 256, (*lead, 9, SIZE, SIZE), dtype=torch.uint8)


class OwnNetwork(nn.Module):
    """Computes something else while it trains, and does not tell its feature_dim."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(9, 8, 3, 2), nn.BatchNorm2d(8), nn.ReLU(), nn.Dropout(0.5), nn.Flatten())

    def forward(self, pixels):
        return self.layers(pixels.float() / 255)


@pytest.mark.parametrize("make", [small_encoder, OwnNetwork])
@pytest.mark.parametrize("lead", [(), (3,), (2, 3)])
def test_any_module_is_an_encoder_for_any_batch_and_stays_frozen(make, lead):
    torch.manual_seed(0)
    encoder = make()
    state = {name: value.clone() for name, value in encoder.state_dict().items()}
    keys = {"in_keys": ["pixels", ("next", "pixels")], "out_keys": ["features", ("next", "features")]}
    td = TensorDict({"pixels": images(*lead), "next": {"pixels": images(*lead)}}, batch_size=lead)
    FrozenEncoder(encoder, **keys).train()(td)
    assert encoder.training  # whoever trains it goes on
    for part in (td, td["next"]):
        with torch.no_grad():
            direct = encoder.eval()(part["pixels"].reshape(-1, 9, SIZE, SIZE))
        assert torch.equal(part["features"], direct.reshape(part["features"].shape))
        assert part["features"].shape[:-1] == lead
        assert not part["features"].requires_grad
    assert all(parameter.requires_grad for parameter in encoder.parameters())
    assert all(torch.equal(value, state[name]) for name, value in encoder.state_dict().items())


def test_who_attaches_it_changes_no_mode_of_the_encoder():
    encoder = OwnNetwork()
    encoder.layers[1].eval()  # somebody keeps these statistics
    modes = [module.training for module in encoder.modules()]
    replay = ReplayBuffer(storage=LazyTensorStorage(4), transform=FrozenEncoder(encoder), batch_size=2)
    replay.extend(TensorDict({"pixels": images(4)}, [4]))
    replay.sample()
    assert [module.training for module in encoder.modules()] == modes


def test_the_spec_says_what_reset_and_step_return():
    encoder = small_encoder()
    encoder.compute_dtype = torch.bfloat16
    env = TransformedEnv(FakePixelEnv(), FrozenEncoder(encoder, out_keys=("agent", "features")))
    spec = env.observation_spec["agent", "features"]
    with torch.no_grad():
        td = env.rand_step(env.reset())
        for part in (td, td["next"]):
            assert torch.equal(part["agent", "features"], encoder(part["pixels"]))
            assert spec.shape == part["agent", "features"].shape
            assert spec.dtype == part["agent", "features"].dtype == torch.bfloat16


def test_pixels_go_to_the_encoders_device_and_features_come_back():
    # Nothing can come back from "meta", but it is attempted: the images have gone there.
    with pytest.raises(NotImplementedError, match="copy out of meta"):
        FrozenEncoder(small_encoder().to("meta"))(TensorDict(pixels=images(2)))


def test_missing_pixels_keys_that_do_not_pair_and_an_encoder_that_returns_no_tensor_are_named():
    frames = FrozenEncoder(small_encoder(), in_keys="frames")
    with pytest.raises(KeyError, match="frames"):
        frames(TensorDict(pixels=images(1)))
    with pytest.raises(KeyError, match="frames"):
        TransformedEnv(FakePixelEnv(), frames).observation_spec  # noqa: B018
    with pytest.raises(ValueError, match="pair up"):
        FrozenEncoder(small_encoder(), in_keys=["a", "b"])
    with pytest.raises(TypeError, match="MaxPool2d returned tuple, not a tensor"):
        FrozenEncoder(nn.MaxPool2d(2, return_indices=True))(TensorDict(pixels=torch.rand(1, 9, 8, 8)))

"""The frozen encoder: any module, any batch, environments and buffers, never a gradient."""

from __future__ import annotations

import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, small_encoder
from tensordict import TensorDict
from torch import nn
from torchrl.envs import SerialEnv, TransformedEnv

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
    for part in (td, td["next"]):
        with torch.no_grad():
            direct = encoder.eval()(part["pixels"].reshape(-1, 9, SIZE, SIZE))
        assert torch.equal(part["features"], direct.reshape(part["features"].shape))
        assert part["features"].shape[:-1] == lead
        assert not part["features"].requires_grad
    assert all(parameter.requires_grad for parameter in encoder.parameters())
    assert all(torch.equal(value, state[name]) for name, value in encoder.state_dict().items())


def test_partial_resets_of_a_batched_environment_renew_only_what_was_reset():
    env = TransformedEnv(SerialEnv(2, FakePixelEnv), FrozenEncoder(small_encoder()))
    td = env.rand_step(env.reset())["next"]
    before = td["features"].clone()
    td["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(td)["features"]
    assert torch.equal(after[1], before[1])
    assert not torch.equal(after[0], before[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_spec_says_what_reset_and_step_return(dtype):
    encoder = small_encoder()
    encoder.compute_dtype = dtype
    env = TransformedEnv(FakePixelEnv(), FrozenEncoder(encoder, out_keys=("agent", "features")))
    spec = env.observation_spec["agent", "features"]
    with torch.no_grad():
        td = env.rand_step(env.reset())
        for part in (td, td["next"]):
            assert torch.equal(part["agent", "features"], encoder(part["pixels"]))
            assert spec.shape == part["agent", "features"].shape
            assert spec.dtype == part["agent", "features"].dtype == dtype


class _ElsewhereEncoder(nn.Module):
    """Lives on "meta", where nothing can be copied back from, and answers from the CPU."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1, device="meta"))
        self.seen = []

    def forward(self, pixels):
        self.seen.append(pixels.device.type)
        return torch.ones(pixels.shape[0], 3)


def test_pixels_go_to_the_encoders_device_and_features_come_back():
    encoder = _ElsewhereEncoder()
    assert FrozenEncoder(encoder)(TensorDict(pixels=images(2)))["features"].device.type == "cpu"
    assert encoder.seen == ["meta"]
    with pytest.raises(NotImplementedError, match="copy out of meta"):  # the way back is attempted
        FrozenEncoder(small_encoder().to("meta"))(TensorDict(pixels=images(2)))


def test_missing_pixels_keys_that_do_not_pair_and_an_encoder_that_returns_no_tensor_are_named():
    frames = FrozenEncoder(small_encoder(), in_keys="frames")
    with pytest.raises(KeyError, match="frames"):
        frames(TensorDict(pixels=images(1)))
    with pytest.raises(KeyError, match="frames"):
        TransformedEnv(FakePixelEnv(), frames).observation_spec  # noqa: B018
    with pytest.raises(ValueError, match="pair up"):
        FrozenEncoder(small_encoder(), in_keys=["a", "b"])

    class Pair(nn.Module):
        def forward(self, pixels):
            return pixels, pixels

    with pytest.raises(TypeError, match="Pair returned tuple, not a tensor"):
        FrozenEncoder(Pair())(TensorDict(pixels=images(1)))

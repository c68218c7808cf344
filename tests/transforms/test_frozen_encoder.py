from __future__ import annotations

import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, small_encoder
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import SerialEnv, TransformedEnv

from crptpro.transforms import FrozenEncoder


def images(*lead):
    return torch.randint(0, 256, (*lead, 9, SIZE, SIZE), dtype=torch.uint8)


@pytest.mark.parametrize("lead", [(), (3,), (2, 3)])
def test_features_equal_a_direct_call_for_any_batch(lead):
    encoder = small_encoder()
    td = TensorDict({"pixels": images(*lead)}, batch_size=lead)
    features = FrozenEncoder(encoder)(td)["features"]
    assert features.shape == (*lead, encoder.feature_dim)
    direct = encoder(td["pixels"].reshape(-1, 9, SIZE, SIZE)).reshape(features.shape)
    assert torch.equal(features, direct.detach())


def test_no_gradient_leaves_the_transform_and_the_encoder_stays_trainable():
    encoder = small_encoder()
    features = FrozenEncoder(encoder)(TensorDict(pixels=images(2)))["features"]
    assert not features.requires_grad
    assert all(parameter.requires_grad for parameter in encoder.parameters())


def test_several_keys_are_encoded_in_a_replay_buffer():
    encoder = small_encoder()
    buffer = ReplayBuffer(storage=LazyTensorStorage(8), batch_size=4)
    buffer.extend(TensorDict({"pixels": images(8), "next": {"pixels": images(8)}}, batch_size=[8]))
    keys = {"in_keys": ["pixels", ("next", "pixels")], "out_keys": ["features", ("next", "features")]}
    buffer.append_transform(FrozenEncoder(encoder, **keys))
    sample = buffer.sample()
    with torch.no_grad():
        assert torch.equal(sample["features"], encoder(sample["pixels"]))
        assert torch.equal(sample["next", "features"], encoder(sample["next", "pixels"]))


def test_an_environment_has_features_after_reset_and_after_step():
    encoder = small_encoder()
    env = TransformedEnv(FakePixelEnv(), FrozenEncoder(encoder))
    with torch.no_grad():
        td = env.reset()
        assert torch.equal(td["features"], encoder(td["pixels"]))
        td = env.step(env.rand_action(td))
        assert torch.equal(td["next", "features"], encoder(td["next", "pixels"]))


def test_partial_resets_of_a_batched_environment_renew_only_what_was_reset():
    encoder = small_encoder()
    env = TransformedEnv(SerialEnv(2, FakePixelEnv), FrozenEncoder(encoder))
    td = env.reset()
    before = td["features"].clone()
    td["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(td)["features"]
    assert torch.equal(after[1], before[1])
    assert not torch.equal(after[0], before[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_spec_says_what_the_rollout_returns(dtype):
    encoder = small_encoder()
    encoder.compute_dtype = dtype
    env = TransformedEnv(FakePixelEnv(), FrozenEncoder(encoder, out_keys=("agent", "features")))
    spec = env.observation_spec["agent", "features"]
    rollout = env.rollout(2)
    assert spec.shape == rollout["agent", "features"].shape[1:] == (encoder.feature_dim,)
    assert spec.dtype == rollout["agent", "features"].dtype == dtype


def test_an_encoder_for_plain_batches_works_without_a_batch():
    encoder = nn.Sequential(nn.Conv2d(9, 2, 3), nn.Flatten())
    td = FrozenEncoder(encoder)(TensorDict(pixels=images().float()))
    assert td["features"].shape == (2 * (SIZE - 2) ** 2,)


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
    transform = FrozenEncoder(encoder)
    assert transform(TensorDict(pixels=images(2)))["features"].device.type == "cpu"
    assert encoder.seen == ["meta"]
    with pytest.raises(NotImplementedError, match="copy out of meta"):  # the way back is attempted
        FrozenEncoder(small_encoder().to("meta"))(TensorDict(pixels=images(2)))


def test_missing_pixels_are_named():
    with pytest.raises(KeyError, match="frames"):
        FrozenEncoder(small_encoder(), in_keys="frames")(TensorDict(pixels=images(1)))
    with pytest.raises(KeyError, match="frames"):
        TransformedEnv(FakePixelEnv(), FrozenEncoder(small_encoder(), in_keys="frames")).observation_spec  # noqa: B018
    with pytest.raises(ValueError, match="length"):
        FrozenEncoder(small_encoder(), in_keys=["a", "b"])

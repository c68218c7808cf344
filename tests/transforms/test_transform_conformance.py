"""TorchRL's checks for its own transforms, on each of ours that an environment may carry."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, small_encoder, small_heads
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from crptpro.transforms import FrozenEncoder, PrototypeReward, RandomShift


def shift_in_place():
    return RandomShift()


def shift_to_a_new_key():
    return RandomShift(in_keys=["pixels"], out_keys=["shifted"])


def frozen_encoder():
    return FrozenEncoder(small_encoder())


def reward_in_place():
    encoder = small_encoder()
    return Compose(FrozenEncoder(encoder), PrototypeReward(*small_heads(encoder), queue_size=16))


def reward_to_a_new_key():
    encoder = small_encoder()
    options = {"queue_size": 16, "in_keys": "z", "out_reward_key": "total"}
    return Compose(FrozenEncoder(encoder, out_keys="z"), PrototypeReward(*small_heads(encoder), **options))


def everything():
    return Compose(RandomShift(), *reward_in_place().transforms)


def transformed(make):
    return TransformedEnv(FakePixelEnv(), make())


FACTORIES = [
    shift_in_place,
    shift_to_a_new_key,
    frozen_encoder,
    reward_in_place,
    reward_to_a_new_key,
    everything,
]
each = pytest.mark.parametrize("make", FACTORIES)


def sampled(count=6):
    pixels = torch.randint(0, 256, (count, 9, SIZE, SIZE), dtype=torch.uint8)
    return TensorDict(
        {"pixels": pixels, "next": {"pixels": pixels.flip(0), "reward": torch.zeros(count, 1)}},
        batch_size=[count],
    )


def offline(make):
    """The transform with what it needs on a replay batch."""
    if make in (shift_in_place, shift_to_a_new_key, frozen_encoder):
        return make()
    encoder = small_encoder()
    encode = FrozenEncoder(encoder, in_keys=[("next", "pixels")], out_keys=[("next", "features")])
    return Compose(encode, PrototypeReward(*small_heads(encoder), queue_size=16))


@each
def test_single_environment(make):
    check_env_specs(transformed(make), seed=0)


@each
def test_serial_environment_of_transformed_ones(make):
    check_env_specs(SerialEnv(2, partial(transformed, make)), seed=0)


@each
def test_transformed_serial_environment(make):
    check_env_specs(TransformedEnv(SerialEnv(2, FakePixelEnv), make()), seed=0)


def test_parallel_environment_of_transformed_ones():
    env = ParallelEnv(2, partial(transformed, everything))
    try:
        check_env_specs(env, seed=0)
    finally:
        env.close(raise_if_closed=False)


def test_transformed_parallel_environment():
    env = TransformedEnv(ParallelEnv(2, FakePixelEnv), everything())
    try:
        check_env_specs(env, seed=0)
    finally:
        env.close(raise_if_closed=False)


@each
def test_without_an_environment(make):
    td = offline(make)(sampled())
    for key in offline(make).out_keys:
        assert key in td.keys(True, True)


@each
def test_inside_a_compose_it_does_what_it_does_alone(make):
    # Deep copies share no generator, so both draw from the global one.
    transform = offline(make)
    alone, composed = copy.deepcopy(transform), Compose(copy.deepcopy(transform))
    torch.manual_seed(0)
    one = alone(sampled(4).zero_())
    torch.manual_seed(0)
    other = composed(sampled(4).zero_())
    assert (one == other).all()


@each
def test_reset_and_step_both_have_the_new_entries(make):
    env = transformed(make)
    root = set(env.observation_spec.keys(True, True))
    after = root | set(env.full_reward_spec.keys(True, True))
    td = env.reset()
    assert root <= set(td.keys(True, True))
    td = env.rand_step(td)
    assert after <= set(td["next"].keys(True, True))


@each
def test_in_front_of_a_module(make):
    model = nn.Sequential(offline(make), nn.Identity())
    assert set(model(sampled()).keys(True, True)) >= {"pixels", ("next", "pixels")}


@each
def test_in_a_replay_buffer(make):
    buffer = ReplayBuffer(storage=LazyTensorStorage(6), batch_size=4)
    stored = sampled()
    buffer.extend(stored.clone())
    buffer.append_transform(offline(make))
    sample = buffer.sample()
    assert sample.batch_size == (4,)
    assert (buffer._storage[:] == stored).all()


@each
def test_the_inverse_changes_nothing(make):
    td = sampled()
    assert (offline(make).inv(td) == td).all()


@each
def test_attaching_switches_to_evaluation_mode_and_it_still_acts(make):
    env = transformed(make)
    assert not env.transform.training
    rollout = env.rollout(2)
    for key in env.full_reward_spec.keys(True, True):
        assert ("next", key) in rollout.keys(True, True) or key in rollout["next"].keys(True, True)


@each
def test_a_clone_has_no_parent_and_can_be_attached_elsewhere(make):
    env = transformed(make)
    clone = env.transform.clone()
    assert clone.parent is None
    check_env_specs(TransformedEnv(FakePixelEnv(), clone), seed=0)


@each
def test_it_is_picklable_before_and_after_use(make):
    transform = offline(make)
    for _ in range(2):
        loaded = pickle.loads(pickle.dumps(transform))
        torch.manual_seed(0)
        one = transform(sampled(3).zero_())
        torch.manual_seed(0)
        other = loaded(sampled(3).zero_())
        assert (one == other).all()


@each
def test_specs_match_the_rollout_in_shape_and_dtype(make):
    env = transformed(make)
    rollout = env.rollout(3)
    for specs in (env.observation_spec, env.full_reward_spec):
        for key, spec in specs.items(True, True):
            value = rollout["next"][key]
            assert value.shape[1:] == spec.shape
            assert value.dtype == spec.dtype
            assert spec.is_in(value[0])


def test_compose_keeps_parents_when_transforms_come_and_go():
    env = transformed(everything)
    removed = env.transform.pop(0)
    assert isinstance(removed, RandomShift)
    env.append_transform(RandomShift(out_keys=["late", ("next", "late")]))
    assert env.transform[-1].parent is not None
    check_env_specs(env, seed=0)

"""TorchRL's checks for its own transforms, on each of ours."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import pytest
import torch
from fake_pixel_env import SIZE, SKILLS, FakePixelEnv, FakeReplay, small_encoder, small_heads
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from crptpro.transforms import (
    ColorSwap,
    ContrastiveReward,
    DenseShiftFeatures,
    FrozenEncoder,
    ParticleReward,
    PrototypeReward,
    RandomShift,
)


def shift_in_place():
    return RandomShift()


def colors_in_place():
    return ColorSwap()


def frozen_encoder():
    return FrozenEncoder(small_encoder())


def prototype(encoder, **options):
    return PrototypeReward(*small_heads(encoder), queue_size=16, knn_k=10, **options)


def particle(encoder):
    return ParticleReward(small_heads(encoder)[0], k=3, coef=0.2)


def contrastive(encoder):
    return ContrastiveReward(small_heads(encoder)[0], coef=0.2)


def prototype_reward():
    encoder = small_encoder()
    return Compose(FrozenEncoder(encoder), prototype(encoder))


def reward_to_a_new_key():
    encoder = small_encoder()
    reward = prototype(encoder, in_keys=("next", "z"), out_keys=("next", "bonus"))
    return Compose(FrozenEncoder(encoder, out_keys="z"), reward)


def particle_reward():
    encoder = small_encoder()
    return Compose(FrozenEncoder(encoder), particle(encoder))


def contrastive_reward():
    encoder = small_encoder()
    return Compose(FrozenEncoder(encoder), contrastive(encoder))


def everything():
    return Compose(RandomShift(), *prototype_reward().transforms)


def dense_features():
    return DenseShiftFeatures(small_encoder(), FakeReplay(BATCH), in_keys=["rows", ("next", "rows")])


def transformed(make):
    return TransformedEnv(FakePixelEnv(), make())


BATCH = 6
BONUS = {("next", "intrinsic_reward"), ("next", "reward")}

# What each changes in, or adds to, a replay batch.
WRITES = {
    shift_in_place: {"pixels", ("next", "pixels")},
    colors_in_place: {"pixels", ("next", "pixels")},
    frozen_encoder: {"features"},
    prototype_reward: {("next", "features")} | BONUS,
    reward_to_a_new_key: {("next", "z"), ("next", "bonus"), ("next", "reward")},
    particle_reward: {("next", "features")} | BONUS,
    contrastive_reward: {("next", "features")} | BONUS,
    everything: {"pixels", ("next", "pixels"), ("next", "features")} | BONUS,
    dense_features: {"features", ("next", "features")},
}
each = pytest.mark.parametrize("make", [make for make in WRITES if make is not dense_features])
each_offline = pytest.mark.parametrize("make", list(WRITES))


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


def sampled():
    pixels = torch.randint(0, 256, (BATCH, 9, SIZE, SIZE), dtype=torch.uint8)
    rows = torch.arange(BATCH)
    following = {"pixels": pixels.flip(0), "rows": rows.flip(0), "reward": torch.rand(BATCH, 1)}
    skill = torch.eye(SKILLS)[rows % SKILLS]
    return TensorDict({"pixels": pixels, "rows": rows, "skill": skill, "next": following}, batch_size=[BATCH])


def offline(make):
    """The transform with what it needs on a replay batch."""
    if make in (shift_in_place, colors_in_place, frozen_encoder, dense_features):
        return make()
    encoder, key = small_encoder(), "z" if make is reward_to_a_new_key else "features"
    encode = FrozenEncoder(encoder, in_keys=[("next", "pixels")], out_keys=[("next", key)])
    rewards = {particle_reward: particle, contrastive_reward: contrastive}
    options = {"in_keys": ("next", "z"), "out_keys": ("next", "bonus")} if make is reward_to_a_new_key else {}
    reward = rewards.get(make, prototype)(encoder, **options)
    return Compose(*([RandomShift()] if make is everything else []), encode, reward)


def changed(before: TensorDictBase, after: TensorDictBase) -> set:
    """Keys that are new, or hold other values than before."""
    known = set(before.keys(True, True))
    return {
        key for key in after.keys(True, True) if key not in known or not torch.equal(after[key], before[key])
    }


def assert_the_same(first, second):
    """Two transforms do the same to two batches in a row: same draws, same queues."""
    for seed in range(2):
        td = sampled()
        results = []
        for transform in (first, second):
            torch.manual_seed(seed)  # they share no generator, so both draw from the global one
            results.append(transform(td.clone()))
        assert changed(*results) == set()
        assert set(results[0].keys(True, True)) == set(results[1].keys(True, True))


@each
def test_single_environment(make):
    check_env_specs(transformed(make), seed=0)


@each
def test_serial_environment_of_transformed_ones(make):
    check_env_specs(SerialEnv(2, partial(transformed, make)), seed=0)


@each
def test_transformed_serial_environment(make):
    check_env_specs(TransformedEnv(SerialEnv(2, FakePixelEnv), make()), seed=0)


@each_offline
def test_without_an_environment(make):
    td = sampled()
    assert changed(td.clone(), offline(make)(td)) == WRITES[make]


@each_offline
def test_in_a_replay_buffer(make):
    buffer = ReplayBuffer(storage=LazyTensorStorage(BATCH), batch_size=4)
    stored = sampled()
    buffer.extend(stored.clone())
    buffer.append_transform(offline(make))
    sample = buffer.sample()
    assert sample.batch_size == (4,)
    assert changed(stored[sample["rows"]], sample) == WRITES[make]
    assert changed(stored, buffer._storage[:]) == set()


@each
def test_attaching_switches_to_evaluation_mode_and_it_still_acts(make):
    # Two of them: rewards that compare the elements of a batch give nothing to a single one.
    plain, env = SerialEnv(2, FakePixelEnv), TransformedEnv(SerialEnv(2, FakePixelEnv), make())
    assert not env.transform.training
    for each_env in (plain, env):
        each_env.set_seed(0)
    plain, rollout = plain.rollout(3), env.rollout(3)
    new = set(rollout["next"].keys(True, True)) - set(plain["next"].keys(True, True))
    assert new == {key[-1] if isinstance(key, tuple) else key for key in WRITES[make]} - {"pixels", "reward"}
    for key in new:
        assert rollout["next"][key].any(), key
    changes_in_place = make in (shift_in_place, colors_in_place, everything)
    for key in ("pixels", ("next", "pixels")):
        assert torch.equal(rollout[key], plain[key]) is not changes_in_place
    bonus = new & {"intrinsic_reward", "bonus"}
    for key in bonus:
        external = rollout["action"].mean(-1, keepdim=True)
        torch.testing.assert_close(rollout["next", "reward"], external + 0.2 * rollout["next", key])


@each
def test_a_clone_has_no_parent_and_can_be_attached_elsewhere(make):
    env = transformed(make)
    clone = env.transform.clone()
    assert clone.parent is None
    check_env_specs(TransformedEnv(FakePixelEnv(), clone), seed=0)


@each_offline
def test_a_clone_does_the_same_without_touching_the_original(make):
    transform = offline(make)
    transform(sampled())
    untouched = copy.deepcopy(transform)
    clone = transform.clone()
    assert_the_same(clone, copy.deepcopy(transform))
    assert_the_same(transform, untouched)


@each_offline
def test_it_is_picklable_before_and_after_use(make):
    transform = offline(make)
    for _ in range(2):
        assert_the_same(pickle.loads(pickle.dumps(transform)), transform)

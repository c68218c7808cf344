"""TorchRL's checks for its own transforms, on each of ours."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import partial

import pytest
import torch
from fake_pixel_env import SIZE, SKILLS, FakePixelEnv, FakeReplay, small_encoder, small_heads
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, SerialEnv, Transform, TransformedEnv
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

BATCH = 6


def prototype(encoder, **options):
    return PrototypeReward(*small_heads(encoder), queue_size=16, knn_k=10, **options)


def particle(encoder):
    return ParticleReward(small_heads(encoder)[0], k=3, coef=0.2)


def contrastive(encoder):
    return ContrastiveReward(small_heads(encoder)[0], coef=0.2)


def to_new_keys(encoder):
    return prototype(encoder, in_keys=("next", "z"), out_keys=("next", "bonus"))


def rewarding(reward: Callable, *before: Callable, key: str = "features") -> Callable:
    """Encode the next observation and reward it, on an environment or a batch."""

    def make(is_offline: bool) -> Transform:
        encoder = small_encoder()
        read, written = (("next", "pixels"), ("next", key)) if is_offline else ("pixels", key)
        encode = FrozenEncoder(encoder, in_keys=[read], out_keys=[written])
        return Compose(*(each() for each in before), encode, reward(encoder))

    return make


IN_PLACE = {"pixels", ("next", "pixels")}
REWARDED = {("next", "features"), ("next", "intrinsic_reward"), ("next", "reward")}

# How each is made, for a batch or an environment, and what it changes in, or adds to, a batch.
CASES: dict[str, tuple[Callable[[bool], Transform], set]] = {
    "shift": (lambda is_offline: RandomShift(), IN_PLACE),
    "colors": (lambda is_offline: ColorSwap(), IN_PLACE),
    "encoder": (lambda is_offline: FrozenEncoder(small_encoder()), {"features"}),
    "prototype": (rewarding(prototype), REWARDED),
    "new keys": (
        rewarding(to_new_keys, key="z"),
        {("next", "z"), ("next", "bonus"), ("next", "reward")},
    ),
    "particle": (rewarding(particle), REWARDED),
    "contrastive": (rewarding(contrastive), REWARDED),
    "everything": (rewarding(prototype, RandomShift), IN_PLACE | REWARDED),
    "dense": (
        lambda is_offline: DenseShiftFeatures(
            small_encoder(), FakeReplay(BATCH), in_keys=["rows", ("next", "rows")]
        ),
        {"features", ("next", "features")},
    ),
}
each = pytest.mark.parametrize("case", [name for name in CASES if name != "dense"])
each_offline = pytest.mark.parametrize("case", list(CASES))


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


def online(case: str) -> Transform:
    return CASES[case][0](False)


def offline(case: str) -> Transform:
    return CASES[case][0](True)


def transformed(case: str) -> TransformedEnv:
    return TransformedEnv(FakePixelEnv(), online(case))


def sampled() -> TensorDict:
    pixels = torch.randint(0, 256, (BATCH, 9, SIZE, SIZE), dtype=torch.uint8)
    rows = torch.arange(BATCH)
    following = {"pixels": pixels.flip(0), "rows": rows.flip(0), "reward": torch.rand(BATCH, 1)}
    skill = torch.eye(SKILLS)[rows % SKILLS]
    return TensorDict({"pixels": pixels, "rows": rows, "skill": skill, "next": following}, batch_size=[BATCH])


def changed(before: TensorDictBase, after: TensorDictBase) -> set:
    """Keys that are new, or hold other values than before."""
    known = set(before.keys(True, True))
    return {
        key for key in after.keys(True, True) if key not in known or not torch.equal(after[key], before[key])
    }


def assert_the_same(first: Transform, second: Transform) -> None:
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
def test_the_specs_of_single_and_batched_environments_hold(case: str) -> None:
    check_env_specs(transformed(case), seed=0)
    check_env_specs(SerialEnv(2, partial(transformed, case)), seed=0)
    check_env_specs(TransformedEnv(SerialEnv(2, FakePixelEnv), online(case)), seed=0)


@each_offline
def test_a_batch_and_a_sample_of_a_buffer_are_changed_and_what_is_stored_is_not(case: str) -> None:
    writes, stored = CASES[case][1], sampled()
    assert changed(stored, offline(case)(stored.clone())) == writes
    buffer = ReplayBuffer(storage=LazyTensorStorage(BATCH), batch_size=4)
    buffer.extend(stored.clone())
    buffer.append_transform(offline(case))
    sample = buffer.sample()
    assert sample.batch_size == (4,)
    assert changed(stored[sample["rows"]], sample) == writes
    assert changed(stored, buffer._storage[:]) == set()


@each
def test_attaching_switches_to_evaluation_mode_and_it_still_acts(case: str) -> None:
    # Two of them: rewards that compare the elements of a batch give nothing to a single one.
    plain, env = SerialEnv(2, FakePixelEnv), TransformedEnv(SerialEnv(2, FakePixelEnv), online(case))
    assert not env.transform.training
    for each_env in (plain, env):
        each_env.set_seed(0)
    plain, rollout = plain.rollout(3), env.rollout(3)
    new = set(rollout["next"].keys(True, True)) - set(plain["next"].keys(True, True))
    writes = CASES[case][1]
    assert new == {key[-1] if isinstance(key, tuple) else key for key in writes} - {"pixels", "reward"}
    for key in new:
        assert rollout["next"][key].any(), key
    for key in ("pixels", ("next", "pixels")):
        assert torch.equal(rollout[key], plain[key]) is (key not in writes)
    for key in new & {"intrinsic_reward", "bonus"}:
        external = rollout["action"].mean(-1, keepdim=True)
        torch.testing.assert_close(rollout["next", "reward"], external + 0.2 * rollout["next", key])


@each
def test_a_clone_has_no_parent_and_can_be_attached_elsewhere(case: str) -> None:
    env = transformed(case)
    clone = env.transform.clone()
    assert clone.parent is None
    check_env_specs(TransformedEnv(FakePixelEnv(), clone), seed=0)


@each_offline
def test_clones_and_pickles_do_the_same_without_touching_the_original(case: str) -> None:
    transform = offline(case)
    assert_the_same(pickle.loads(pickle.dumps(transform)), copy.deepcopy(transform))
    transform(sampled())
    untouched = copy.deepcopy(transform)
    assert_the_same(transform.clone(), copy.deepcopy(transform))
    assert_the_same(pickle.loads(pickle.dumps(transform)), copy.deepcopy(transform))
    assert_the_same(transform, untouched)

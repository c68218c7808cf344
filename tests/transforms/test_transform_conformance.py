from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import partial

import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, FakeReplay, small_encoder, small_heads
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


def rewarding(make: Callable[..., Transform]) -> Transform:
    encoder = small_encoder()
    encode = FrozenEncoder(encoder, in_keys=[("next", "pixels")], out_keys=[("next", "features")])
    return Compose(encode, make(*small_heads(encoder)))


REWARDED = {("next", "features"), ("next", "intrinsic_reward"), ("next", "reward")}

# How each is made, and what it changes in, or adds to, a batch; the first three are for environments.
CASES: dict[str, tuple[Callable[[], Transform], set]] = {
    "shift": (partial(RandomShift, ["pixels"]), {"pixels"}),
    "colors": (partial(ColorSwap, ["pixels"]), {"pixels"}),
    "encoder": (lambda: FrozenEncoder(small_encoder()), {"features"}),
    "prototype": (partial(rewarding, lambda z, c: PrototypeReward(z, c, queue_size=16, knn_k=10)), REWARDED),
    "particle": (partial(rewarding, lambda z, _: ParticleReward(z, k=3, coef=0.2)), REWARDED),
    "contrastive": (partial(rewarding, lambda z, _: ContrastiveReward(z, coef=0.2)), REWARDED),
    "dense": (
        lambda: DenseShiftFeatures(small_encoder(), FakeReplay(BATCH), in_keys=["rows", ("next", "rows")]),
        {"features", ("next", "features")},
    ),
}
each = pytest.mark.parametrize("case", list(CASES))
each_online = pytest.mark.parametrize("case", list(CASES)[:3])
each_offline = pytest.mark.parametrize("case", list(CASES)[3:])


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


def made(case: str) -> Transform:
    return CASES[case][0]()


def sampled() -> TensorDict:
    pixels = torch.randint(0, 256, (BATCH, 9, SIZE, SIZE), dtype=torch.uint8)
    rows = torch.arange(BATCH)
    following = {"pixels": pixels.flip(0), "rows": rows.flip(0), "reward": torch.rand(BATCH, 1)}
    skill = torch.eye(3)[rows % 3]
    return TensorDict({"pixels": pixels, "rows": rows, "skill": skill, "next": following}, batch_size=[BATCH])


def changed(before: TensorDictBase, after: TensorDictBase) -> set:
    """Keys that are new, or hold other values than before."""
    known = set(before.keys(True, True))
    return {key for key in after.keys(True, True) if key not in known or not torch.equal(after[key], before[key])}


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


@each_online
def test_the_specs_of_single_and_batched_environments_hold_with_a_clone_too(case: str) -> None:
    env = TransformedEnv(FakePixelEnv(), made(case))
    check_env_specs(env, seed=0)
    clone = env.transform.clone()
    assert clone.parent is None
    check_env_specs(TransformedEnv(FakePixelEnv(), clone), seed=0)
    check_env_specs(SerialEnv(2, lambda: TransformedEnv(FakePixelEnv(), made(case))), seed=0)
    check_env_specs(TransformedEnv(SerialEnv(2, FakePixelEnv), made(case)), seed=0)


@each_online
def test_attaching_switches_to_evaluation_mode_and_it_still_acts_at_reset_and_step(case: str) -> None:
    plain, env = FakePixelEnv(), TransformedEnv(FakePixelEnv(), made(case))
    assert not env.transform.training
    plain, rollout = plain.rollout(3), env.rollout(3)
    for before, after in ((plain[0], rollout[0]), (plain["next"], rollout["next"])):
        found = changed(before.select("pixels"), after.select("pixels", "features", strict=False))
        assert found == CASES[case][1] & {"pixels", "features"}


@each_offline
def test_what_compares_the_rows_of_a_batch_is_refused_by_an_environment(case: str) -> None:
    transform = made(case)
    last = transform if case == "dense" else transform[-1]
    with pytest.raises(NotImplementedError, match=type(last).__name__):
        TransformedEnv(FakePixelEnv(), last.clone()).observation_spec  # noqa: B018


@each
def test_a_batch_and_a_sample_of_a_buffer_are_changed_and_what_is_stored_is_not(case: str) -> None:
    writes, stored = CASES[case][1], sampled()
    assert changed(stored, made(case)(stored.clone())) == writes
    buffer = ReplayBuffer(storage=LazyTensorStorage(BATCH), batch_size=4)
    buffer.extend(stored.clone())
    buffer.append_transform(made(case))
    sample = buffer.sample()
    assert sample.batch_size == (4,)
    assert changed(stored[sample["rows"]], sample) == writes
    assert changed(stored, buffer.storage[:]) == set()


@each
def test_clones_and_pickles_do_the_same_without_touching_the_original(case: str) -> None:
    transform = made(case)
    assert_the_same(pickle.loads(pickle.dumps(transform)), copy.deepcopy(transform))
    transform(sampled())
    untouched = copy.deepcopy(transform)
    assert_the_same(transform.clone(), copy.deepcopy(transform))
    assert_the_same(pickle.loads(pickle.dumps(transform)), copy.deepcopy(transform))
    assert_the_same(transform, untouched)

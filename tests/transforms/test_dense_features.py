from __future__ import annotations

import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, small_encoder, small_heads
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv

from crptpro.transforms import DenseShiftCache, DenseShiftFeatures, FrozenEncoder, RandomShift

SLOTS = 12
NEXT_Z = [None, ("next", "embeddings")]


@pytest.fixture
def encoder():
    return small_encoder()


@pytest.fixture
def frames():
    return torch.randint(0, 256, (SLOTS, 9, SIZE, SIZE), dtype=torch.uint8)


@pytest.fixture
def cache(encoder, frames):
    cache = DenseShiftCache(encoder, SLOTS, dtype=torch.float32)
    cache.write(torch.arange(SLOTS), frames)
    return cache


def transitions(frames, *lead):
    rows = torch.randint(0, SLOTS - 1, lead)
    return TensorDict(
        {"rows": rows, "pixels": frames[rows], "next": {"rows": rows + 1, "pixels": frames[rows + 1]}},
        batch_size=lead,
    )


def seeded(seed=3):
    return torch.Generator().manual_seed(seed)


def close(ours, theirs):
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6 * float(theirs.max()))


@pytest.mark.parametrize("lead", [(7,), (2, 4)])
def test_both_modes_equal_shifting_and_encoding_with_the_same_generator(encoder, cache, frames, lead):
    td = transitions(frames, *lead)
    dense = DenseShiftFeatures(cache, generator=seeded())(td.clone())
    again = DenseShiftFeatures(mode="reencode", encoder=encoder, generator=seeded())(td.clone())
    keys = {"in_keys": ["pixels", ("next", "pixels")], "out_keys": ["features", ("next", "features")]}
    plain = FrozenEncoder(encoder, **keys)(RandomShift(generator=seeded())(td.clone()))
    for key in ("features", ("next", "features")):
        assert dense[key].shape == (*lead, encoder.feature_dim)
        close(dense[key], plain[key])
        assert torch.equal(again[key], plain[key])


def test_observation_and_next_observation_draw_independent_shifts(cache, frames):
    rows = torch.full((50,), 4)
    td = TensorDict({"rows": rows, "next": {"rows": rows}}, batch_size=[50])
    DenseShiftFeatures(cache, generator=seeded())(td)
    same = (td["features"] == td["next", "features"]).all(-1)
    assert same.sum() < 10
    assert len(td["features"].unique(dim=0)) > 25


def test_embeddings_belong_to_the_same_shift_in_every_mode(encoder, frames):
    projector, _ = small_heads(encoder)
    td = transitions(frames, 9)
    stored = DenseShiftCache(encoder, SLOTS, dtype=torch.float32, projector=projector)
    bare = DenseShiftCache(encoder, SLOTS, dtype=torch.float32)
    for cache in (stored, bare):
        cache.write(torch.arange(SLOTS), frames)
    results = [
        DenseShiftFeatures(stored, embedding_keys=NEXT_Z, generator=seeded()),
        DenseShiftFeatures(bare, projector=projector, embedding_keys=NEXT_Z, generator=seeded()),
        DenseShiftFeatures(
            mode="reencode", encoder=encoder, projector=projector, embedding_keys=NEXT_Z, generator=seeded()
        ),
    ]
    for transform in results:
        out = transform(td.clone())
        with torch.no_grad():
            expected = projector(out["next", "features"])
        torch.testing.assert_close(out["next", "embeddings"], expected, rtol=1e-5, atol=1e-5)
        assert "embeddings" not in out
        assert not out["next", "embeddings"].requires_grad


def test_it_reads_scalar_columns_of_a_replay_buffer_and_leaves_storage_alone(cache, frames):
    buffer = ReplayBuffer(storage=LazyTensorStorage(SLOTS - 1), batch_size=6)
    rows = torch.arange(SLOTS - 1).unsqueeze(-1)
    buffer.extend(TensorDict({"rows": rows, "next": {"rows": rows + 1}}, batch_size=[SLOTS - 1]))
    buffer.append_transform(DenseShiftFeatures(cache))
    sample = buffer.sample()
    assert sample["features"].shape == (6, cache.feature_dim)
    assert set(buffer._storage[:].keys(True, True)) == {"rows", ("next", "rows")}


def test_reused_output_is_overwritten_by_the_next_call_only_when_asked_for(cache, frames):
    td = transitions(frames, 5)
    for reuse in (False, True):
        transform = DenseShiftFeatures(cache, generator=seeded(), reuse_output=reuse)
        first = transform(td.clone())["features"]
        kept = first.clone()
        second = transform(td.clone())["features"]
        assert not torch.equal(second, kept)
        assert torch.equal(first, kept) is not reuse


def test_a_clone_does_not_write_over_the_batch_of_the_original(cache, frames):
    transform = DenseShiftFeatures(cache, generator=seeded(), reuse_output=True)
    td = transitions(frames, 5)
    first = transform(td.clone())["features"]
    kept = first.clone()
    second = transform.clone()(td.clone())["features"]
    assert not torch.equal(second, kept)
    assert torch.equal(first, kept)


def test_a_changed_batch_size_gets_a_new_output(cache, frames):
    transform = DenseShiftFeatures(cache, reuse_output=True)
    assert transform(transitions(frames, 5))["features"].shape[0] == 5
    assert transform(transitions(frames, 3))["features"].shape[0] == 3


def test_features_come_in_the_dtype_asked_for(cache, encoder, frames):
    for transform in (
        DenseShiftFeatures(cache, features_dtype=torch.bfloat16),
        DenseShiftFeatures(mode="reencode", encoder=encoder, features_dtype=torch.bfloat16),
    ):
        assert transform(transitions(frames, 2))["features"].dtype == torch.bfloat16


def test_keys_are_configurable_and_may_be_one(cache):
    transform = DenseShiftFeatures(cache, slot_keys=("store", "slot"), out_keys=("agent", "features"))
    td = transform(TensorDict({"store": {"slot": torch.arange(4)}}, batch_size=[4]))
    assert td["agent", "features"].shape == (4, cache.feature_dim)


def test_what_is_missing_is_named(cache, encoder, frames):
    with pytest.raises(ValueError, match="cache"):
        DenseShiftFeatures()
    with pytest.raises(ValueError, match="encoder"):
        DenseShiftFeatures(mode="reencode")
    with pytest.raises(ValueError, match="auto"):
        DenseShiftFeatures(cache, mode="auto")
    with pytest.raises(ValueError, match="length"):
        DenseShiftFeatures(cache, slot_keys=["rows"])
    with pytest.raises(ValueError, match="projector"):
        DenseShiftFeatures(cache, embedding_keys=NEXT_Z)
    with pytest.raises(KeyError, match="rows"):
        DenseShiftFeatures(cache)(TensorDict(pixels=frames))


def test_an_environment_is_refused_with_the_remedy(cache):
    with pytest.raises(NotImplementedError, match="FrozenEncoder"):
        TransformedEnv(FakePixelEnv(), DenseShiftFeatures(cache)).observation_spec  # noqa: B018

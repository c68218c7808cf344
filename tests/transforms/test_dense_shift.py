"""Dense-shift features: bit for bit what shifting and encoding gives, encoded once per observation."""

from __future__ import annotations

import copy
import pickle
import threading

import numpy as np
import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, FakeReplay, small_encoder, small_heads
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, TransformedEnv
from toy_world import rollout_of

from crptpro.data import FrameReplay
from crptpro.modules import PixelEncoder
from crptpro.transforms import (
    DenseShiftFeatures,
    FrozenEncoder,
    RandomShift,
    choose_feature_mode,
    random_shift,
)
from crptpro.transforms.dense_shift import (
    _crop_by_index,
    crop_features,
    dense_maps_bytes,
    dense_shift_geometry,
    dense_shift_maps,
)

ALL_SHIFTS = torch.cartesian_prod(torch.arange(9), torch.arange(9))
KEYS = {"in_keys": ["pixels", ("next", "pixels")], "out_keys": ["features", ("next", "features")]}


def seeded(seed=3):
    return torch.Generator().manual_seed(seed)


def reencoding(encoder, **options):
    """What the dense features replace."""
    shift = RandomShift(in_keys=KEYS["in_keys"], generator=seeded(), **options)
    return Compose(shift, FrozenEncoder(encoder, **KEYS))


def same(ours, theirs):
    """Up to the order of a sum, which may depend on the size of image and batch on some processors."""
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6 * float(theirs.abs().max()))


# Maps and crops ------------------------------------------------------------------------------------------


def crops_and_features(encoder, pixels, pad=4):
    side = torch.arange(2 * pad + 1)
    offsets = torch.cartesian_prod(side, side)
    maps = dense_shift_maps(encoder, pixels.unsqueeze(0), pad=pad)
    rows = torch.zeros(len(offsets), dtype=torch.int64)
    with torch.no_grad():
        direct = encoder(random_shift(pixels.expand(len(offsets), *pixels.shape), offsets, pad=pad))
    return crop_features(maps, offsets, pad=pad, rows=rows), direct


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"channels": (4, 6, 5), "strides": (2, 2, 1), "image_size": 25},
        {"strides": (1, 1)},
        {"strides": (3, 1), "image_size": 21},
        {"pixel_offset": 0.5},
    ],
)
def test_float32_crops_equal_direct_features_for_every_shift_and_geometry(changes):
    encoder = small_encoder(**changes)
    optimizer = torch.optim.Adam(encoder.parameters(), lr=1e-2)
    pixels = torch.randint(0, 256, (9, encoder.image_size, encoder.image_size), dtype=torch.uint8)
    (encoder(pixels) - 1).square().mean().backward()
    optimizer.step()  # not only as drawn
    same(*crops_and_features(encoder, pixels))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_default_encoder_gives_all_81_shifts_bit_for_bit_in_float32_and_rounded_in_bfloat16(dtype):
    encoder = PixelEncoder()
    encoder.compute_dtype = dtype
    crops, direct = crops_and_features(encoder, torch.randint(0, 256, (9, 84, 84), dtype=torch.uint8))
    tolerance = 0 if dtype == torch.float32 else 2**-8 * float(direct.abs().max())
    torch.testing.assert_close(crops, direct, rtol=0, atol=tolerance)
    geometry = dense_shift_geometry(encoder)
    assert geometry.maps_shape == (4, 32, 39, 39)
    assert (geometry.phases, geometry.window) == (2, 92)
    assert dense_maps_bytes(encoder, 1, torch.bfloat16) == 2 * 194_688


def test_indexing_as_on_a_gpu_gives_the_same_crops_as_slicing():
    maps, rows = torch.randn(7, 4, 3, 11, 12), torch.randint(0, 7, (81,))
    indexed = _crop_by_index(maps, rows, ALL_SHIFTS, 2, (5, 7, 8))
    assert torch.equal(indexed, crop_features(maps, ALL_SHIFTS, rows=rows))


def test_crops_of_bfloat16_maps_come_in_float32_with_the_same_values_also_into_given_memory():
    maps, rows = torch.randn(7, 4, 3, 11, 12).bfloat16(), torch.randint(0, 7, (81,))
    maps[0, 0, 0, 0, :4] = torch.tensor([-0.0, torch.inf, -torch.inf, 1e-40])
    expected = crop_features(maps, ALL_SHIFTS, rows=rows)
    out = torch.full((81, 3 * 7 * 8), torch.nan)
    for given in (None, out):
        crops = crop_features(maps, ALL_SHIFTS, rows=rows, out=given, dtype=torch.float32)
        assert torch.equal(crops.view(torch.int32), expected.float().view(torch.int32))
    assert crops is out
    with pytest.raises(ValueError, match="expected out of shape"):
        crop_features(maps, ALL_SHIFTS, rows=rows, out=out)
    with pytest.raises(ValueError, match=r"maps in torch\.bfloat16 .* got torch\.float64"):
        crop_features(maps, ALL_SHIFTS, rows=rows, dtype=torch.float64)


def test_what_has_no_dense_maps_and_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="got Conv2d; encode shifted images instead"):
        dense_shift_geometry(nn.Conv2d(9, 4, 3, padding=1))
    with pytest.raises(ValueError, match="total stride 16"):
        dense_shift_geometry(small_encoder(strides=(4, 4), image_size=40))
    encoder = small_encoder()
    with pytest.raises(ValueError, match="expected pixels"):
        dense_shift_maps(encoder, torch.zeros(1, 9, SIZE + 1, SIZE, dtype=torch.uint8))
    maps = dense_shift_maps(encoder, torch.zeros(1, 9, SIZE, SIZE, dtype=torch.uint8), dtype=torch.bfloat16)
    assert (maps.requires_grad, maps.dtype) == (False, torch.bfloat16)
    with pytest.raises(ValueError, match=r"0\.\.8"):
        crop_features(maps, torch.tensor([[9, 0]]))
    with pytest.raises(ValueError, match="expected offsets"):
        crop_features(maps, torch.tensor([[0, 0], [1, 1]]))


# The transform -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lead", [(7,), (2, 4)])
@pytest.mark.parametrize("is_standardised", [False, True])
def test_it_writes_what_shifting_and_encoding_with_the_same_generator_writes(lead, is_standardised):
    encoder, replay = small_encoder(), FakeReplay()
    if is_standardised:
        encoder.standardise(torch.rand(encoder.feature_dim), torch.rand(encoder.feature_dim) + 0.5)
    dense, plain = DenseShiftFeatures(encoder, replay, generator=seeded()), reencoding(encoder)
    for _ in range(3):
        td = replay.batch(*lead)
        ours, theirs = dense(td.clone()), plain(td.clone())
        for key in KEYS["out_keys"]:
            assert ours[key].shape == (*lead, encoder.feature_dim)
            assert not ours[key].requires_grad
            same(ours[key], theirs[key])


def test_each_observation_is_encoded_once_until_its_place_is_needed():
    encoder, replay = small_encoder(), FakeReplay(12)
    dense = DenseShiftFeatures(encoder, replay, generator=seeded())
    for _ in range(30):
        dense(replay.batch(8))
    assert sorted(replay.asked) == list(range(12))
    plain = reencoding(encoder)
    dense.generator.manual_seed(3)
    td = replay.batch(20, first=7)  # numbers 12 to 18 take the places of 0 to 6
    ours, theirs = dense(td.clone()), plain(td.clone())
    same(ours["next", "features"], theirs["next", "features"])
    assert set(replay.asked[12:]) <= set(range(12, 19))


def test_it_follows_a_frame_replay_around_its_ring_and_survives_a_resumption(tmp_path):
    encoder = small_encoder()
    kwargs = {"frame_shape": (3, SIZE, SIZE), "action_dim": 1, "slack": 40}
    replay = FrameReplay(10, path=tmp_path, **kwargs)
    replay.set_rng(seeded(1))
    dense, plain = DenseShiftFeatures(encoder, replay, generator=seeded()), reencoding(encoder)
    for length in (4, 7, 1, 9, 3):
        replay.extend(rollout_of(torch.randint(0, 256, (length + 1, 3, SIZE, SIZE), dtype=torch.uint8)))
        td = replay.sample(16)
        ours, theirs = dense(td.clone()), plain(td.clone())
        for key in KEYS["out_keys"]:
            same(ours[key], theirs[key])
    state, rng = replay.state_dict(), seeded(5)
    again = FrameReplay(10, path=tmp_path, **kwargs)
    again.load_state_dict(state)
    resumed = DenseShiftFeatures(encoder, again, generator=copy.deepcopy(dense.generator))
    for each in (replay, again):
        each.set_rng(copy.deepcopy(rng))
    first = dense(replay.sample(16))["features"].clone()
    assert torch.equal(resumed(again.sample(16))["features"], first)


def test_maps_in_bfloat16_round_each_feature_of_a_float32_encoder_once():
    encoder, replay = small_encoder(), FakeReplay()
    whole = DenseShiftFeatures(encoder, replay, generator=seeded())
    half = DenseShiftFeatures(encoder, replay, generator=seeded(), dtype=torch.bfloat16)
    td = replay.batch(9)
    expected = whole(td.clone())["features"].bfloat16().float()
    assert torch.equal(half(td.clone())["features"], expected)


def test_projections_of_every_shift_are_kept_and_written_for_the_next_observation():
    encoder, replay = small_encoder(), FakeReplay()
    projector, _ = small_heads(encoder)
    dense = DenseShiftFeatures(encoder, replay, projector=projector, generator=seeded())
    assert dense_maps_bytes(encoder, 12, torch.float32, latent_dim=5) == 12 * (
        4 * 6 * 11 * 11 * 4 + 81 * 5 * 4
    )
    for _ in range(20):
        td = dense(replay.batch(16))
        with torch.no_grad():
            expected = projector(td["next", "features"])
        torch.testing.assert_close(td["next", "embedding"], expected, rtol=1e-5, atol=1e-5)
        assert "embedding" not in td
    projector.register_forward_hook(lambda *call: pytest.fail("projected again"))
    assert not dense(replay.batch(16))["next", "embedding"].requires_grad


def test_features_are_valid_until_the_next_call_of_the_same_thread():
    encoder, replay = small_encoder(), FakeReplay()
    dense = DenseShiftFeatures(encoder, replay, generator=seeded())
    first = dense(replay.batch(5))["features"]
    kept = first.clone()
    threading.Thread(target=lambda: dense(replay.batch(5))).start()
    clone = dense.clone()
    assert not torch.equal(clone(replay.batch(5))["features"], kept)
    assert torch.equal(first, kept)
    second = dense(replay.batch(5))["features"]
    assert second.data_ptr() == first.data_ptr()
    assert dense(replay.batch(3))["features"].shape[0] == 3


def test_threads_that_sample_side_by_side_get_each_their_own():
    encoder, replay = small_encoder(), FakeReplay()
    dense = DenseShiftFeatures(encoder, replay)
    plain = {n: crops_and_features(encoder, replay.frames[n])[1] for n in range(12)}
    wrong: list[int] = []

    def sample():
        for _ in range(20):
            td = dense(replay.batch(6))
            for number, features in zip(td["number"].tolist(), td["features"]):
                if not ((plain[number] - features).abs().amax(-1) < 1e-5).any():
                    wrong.append(number)

    threads = [threading.Thread(target=sample) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_hold_no_maps_and_no_state_and_give_the_same(duplicate):
    encoder, replay = small_encoder(), FakeReplay()
    dense = DenseShiftFeatures(encoder, replay, generator=seeded())
    td = replay.batch(6)
    dense(td.clone())
    twin = duplicate(dense)
    assert torch.equal(twin(td.clone())["features"], dense(td.clone())["features"])
    assert not dense.state_dict()
    assert set(twin.replay.asked) - set(replay.asked) == set()


def test_numbers_that_go_back_are_encoded_anew_after_forget():
    encoder, replay = small_encoder(), FakeReplay()
    dense = DenseShiftFeatures(encoder, replay)
    number = TensorDict({"number": torch.tensor([[2]]), "next": {"number": torch.tensor([[3]])}}, [1])
    before = dense(number.clone())["features"].clone()
    replay.frames = replay.frames.flip(0)
    for forget in (dense.forget, lambda: dense.load_state_dict({})):
        forget()
        after = dense(number.clone())["features"]
        assert after.shape == before.shape == (1, encoder.feature_dim)
        assert not torch.equal(after, before)


def test_too_few_places_are_refused_instead_of_giving_features_of_another_observation():
    encoder, replay = small_encoder(), FakeReplay()
    dense = DenseShiftFeatures(
        encoder, replay, observations=np.int64(4), in_keys="number", out_keys="features"
    )
    assert dense(TensorDict({"number": torch.tensor([0, 5])}, [2]))["features"].shape[0] == 2
    with pytest.raises(ValueError, match="`observations` is 4, fewer than the replay holds"):
        dense(TensorDict({"number": torch.tensor([1, 5])}, [2]))


def test_what_is_missing_or_does_not_fit_is_named():
    encoder, replay = small_encoder(), FakeReplay()
    dense = DenseShiftFeatures(encoder, replay)
    with pytest.raises(KeyError, match="'number'"):
        dense(TensorDict(pixels=replay.frames))
    with pytest.raises(ValueError, match="pair up"):
        DenseShiftFeatures(encoder, replay, in_keys=["number"])
    with pytest.raises(ValueError, match="got Flatten"):
        DenseShiftFeatures(nn.Flatten(), replay)
    with pytest.raises(ValueError, match="`observations` must be at least 1"):
        DenseShiftFeatures(encoder, replay, observations=0)
    with pytest.raises(NotImplementedError, match="FrozenEncoder"):
        TransformedEnv(FakePixelEnv(), dense).observation_spec  # noqa: B018


# The choice ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoder", "available", "options", "mode", "why"),
    [
        (PixelEncoder(), 22 * 2**30, {}, "dense", "14.5 GiB for 40000 observations"),
        (PixelEncoder(), 16 * 2**30, {}, "reencode", "too little memory"),
        (PixelEncoder(), 22 * 2**30, {"latent_dim": 512}, "reencode", "too little memory"),
        (nn.Flatten(), 2**40, {}, "reencode", "PixelEncoder, got Flatten"),
        (PixelEncoder(strides=(4, 4, 1, 1)), 2**40, {}, "reencode", "total stride 16"),
    ],
)
def test_auto_takes_dense_maps_where_they_fit_and_says_why_in_one_line(
    encoder, available, options, mode, why
):
    chosen, reason = choose_feature_mode("auto", encoder, 40_000, torch.bfloat16, available, **options)
    assert chosen == mode
    assert why in reason
    assert "\n" not in reason


@pytest.mark.parametrize(("available_gib", "would_fit"), [(22, True), (16, False)])
def test_too_little_memory_for_float32_says_whether_bf16_would_fit(available_gib: int, would_fit: bool):
    mode, reason = choose_feature_mode("auto", PixelEncoder(), 40_000, torch.float32, available_gib * 2**30)
    assert mode == "reencode"
    assert ("in bf16, by dense_precision, it would fit with 14.5 GiB" in reason) is would_fit


def test_explicit_modes_are_obeyed_or_refused_and_memory_is_measured(caplog):
    assert choose_feature_mode("reencode", PixelEncoder(), 1)[0] == "reencode"
    assert choose_feature_mode("auto", PixelEncoder(), 1)[0] == "dense"
    assert choose_feature_mode("auto", PixelEncoder(), 10**9)[0] == "reencode"
    assert choose_feature_mode("dense", PixelEncoder(), 1000, torch.bfloat16, 2**40)[0] == "dense"
    assert not caplog.records
    assert choose_feature_mode("dense", PixelEncoder(), 1000, torch.bfloat16, 2**20)[0] == "dense"
    assert "may not fit: 0.4 GiB for 1000 observations, 0.0 GiB free" in caplog.text
    with pytest.raises(ValueError, match="Flatten"):
        choose_feature_mode("dense", nn.Flatten(), 1)
    with pytest.raises(ValueError, match="cached"):
        choose_feature_mode("cached", PixelEncoder(), 1)

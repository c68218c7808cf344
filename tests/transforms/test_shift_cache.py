from __future__ import annotations

import logging

import pytest
import torch
from fake_pixel_env import SIZE, small_encoder, small_heads
from torch import nn

from crptpro.modules import PixelEncoder
from crptpro.transforms import DenseShiftCache, choose_feature_mode, draw_offsets, random_shift


def images(count):
    return torch.randint(0, 256, (count, 9, SIZE, SIZE), dtype=torch.uint8)


@pytest.fixture
def encoder():
    return small_encoder()


def test_features_read_back_equal_shift_then_encode(encoder):
    cache = DenseShiftCache(encoder, 10, dtype=torch.float32)
    pixels = images(10)
    cache.write(torch.randperm(10), images(10))  # overwritten
    cache.write(torch.arange(10), pixels)
    slots, offsets = torch.randint(0, 10, (40,)), draw_offsets(40, 4)
    with torch.no_grad():
        direct = encoder(random_shift(pixels[slots], offsets))
    torch.testing.assert_close(cache.gather(slots, offsets), direct, rtol=0, atol=1e-6 * float(direct.max()))


def test_bfloat16_storage_rounds_the_features_and_nothing_else(encoder):
    pixels = images(3)
    exact, rounded = (DenseShiftCache(encoder, 3, dtype=dtype) for dtype in (torch.float32, torch.bfloat16))
    for cache in (exact, rounded):
        cache.write(torch.arange(3), pixels)
    slots, offsets = torch.randint(0, 3, (20,)), draw_offsets(20, 4)
    assert torch.equal(rounded.gather(slots, offsets), exact.gather(slots, offsets).bfloat16())


def test_the_center_is_the_plain_encoding(encoder):
    cache = DenseShiftCache(encoder, 4, dtype=torch.float32)
    pixels = images(4)
    cache.write(torch.arange(4), pixels)
    with torch.no_grad():
        plain = encoder(pixels)
    torch.testing.assert_close(cache.center(torch.arange(4)), plain, rtol=0, atol=1e-6 * float(plain.max()))
    assert torch.equal(cache.center(2), cache.center(torch.tensor([2]))[0])


def test_writing_one_by_one_equals_writing_a_batch(encoder):
    """A resumed run refills the cache in batches and must continue with the same numbers."""
    pixels = images(40)
    one, many = (DenseShiftCache(encoder, 40, dtype=torch.float32) for _ in range(2))
    many.write(torch.arange(40), pixels)
    for slot in range(40):
        one.write(slot, pixels[slot])
    slots, offsets = torch.arange(40), draw_offsets(40, 4)
    assert torch.equal(one.gather(slots, offsets), many.gather(slots, offsets))


def test_cached_embeddings_equal_projecting_the_features(encoder):
    projector, _ = small_heads(encoder)
    cache = DenseShiftCache(encoder, 5, dtype=torch.bfloat16, projector=projector)
    cache.write(torch.arange(5), images(5))
    side = torch.arange(9)
    offsets = torch.cartesian_prod(side, side)
    slots = torch.randint(0, 5, (81,))
    with torch.no_grad():
        direct = projector(cache.gather(slots, offsets))
    torch.testing.assert_close(cache.gather_embeddings(slots, offsets), direct, rtol=1e-5, atol=1e-5)


def test_embeddings_need_a_projector(encoder):
    cache = DenseShiftCache(encoder, 1)
    cache.write(0, images(1)[0])
    with pytest.raises(RuntimeError, match="projector"):
        cache.gather_embeddings(torch.tensor([0]), torch.tensor([[4, 4]]))


def test_memory_is_announced_and_counted(encoder, caplog):
    projector, _ = small_heads(encoder, latent_dim=5)
    with caplog.at_level(logging.DEBUG, logger="crptpro.transforms.shift_cache"):
        cache = DenseShiftCache(encoder, 100, projector=projector)
    assert "GiB" in caplog.text
    assert "100 observations" in caplog.text
    values = 4 * 6 * 11 * 11
    assert cache.nbytes == 100 * (values * 2 + 81 * 5 * 4)


def test_reading_a_slot_that_was_never_written_is_refused(encoder):
    cache = DenseShiftCache(encoder, 3)
    cache.write(1, images(1)[0])
    with pytest.raises(IndexError, match=r"\[0, 2\]"):
        cache.gather(torch.tensor([0, 1, 2]), torch.zeros(3, 2, dtype=torch.int64))


@pytest.mark.parametrize("slot", [-1, 3])
def test_reading_outside_the_store_is_refused_and_negative_slots_do_not_wrap(encoder, slot):
    cache = DenseShiftCache(encoder, 3)
    cache.write(torch.arange(3), images(3))
    with pytest.raises(
        IndexError, match=rf"slots {min(slot, 0)}\.\.{max(slot, 0)} .* store of 3; use 0\.\.2"
    ):
        cache.gather(torch.tensor([slot, 0]), torch.zeros(2, 2, dtype=torch.int64))


def test_writing_outside_the_store_is_refused(encoder):
    cache = DenseShiftCache(encoder, 3)
    for slot in (3, -1):
        with pytest.raises(IndexError, match="store of 3"):
            cache.write(slot, images(1)[0])
    with pytest.raises(ValueError, match="2 slots for 1"):
        cache.write(torch.tensor([0, 1]), images(1))
    with pytest.raises(ValueError, match="slots"):
        DenseShiftCache(encoder, 0)


def test_auto_takes_the_cache_when_memory_suffices():
    mode, reason = choose_feature_mode("auto", PixelEncoder(), 40_000, torch.bfloat16, 22 * 2**30)
    assert mode == "dense"
    assert "14.5 GiB for 40000 observations" in reason


@pytest.mark.parametrize(
    ("encoder", "available", "why"),
    [
        (PixelEncoder(), 16 * 2**30, "memory"),
        (nn.Flatten(), 2**40, "PixelEncoder, got Flatten"),
        (PixelEncoder(strides=(4, 4, 1, 1)), 2**40, "total stride 16"),
    ],
)
def test_auto_falls_back_with_a_one_line_reason(encoder, available, why):
    mode, reason = choose_feature_mode("auto", encoder, 40_000, torch.bfloat16, available)
    assert mode == "reencode"
    assert why in reason
    assert "\n" not in reason


@pytest.mark.parametrize(("available_gib", "would_fit"), [(22, True), (16, False)])
def test_too_little_memory_for_float32_says_whether_bf16_would_fit(available_gib: int, would_fit: bool):
    mode, reason = choose_feature_mode("auto", PixelEncoder(), 40_000, torch.float32, available_gib * 2**30)
    assert mode == "reencode"
    assert ("in bf16, by dense_precision, it would fit with 14.5 GiB" in reason) is would_fit


def test_a_cache_that_is_asked_for_and_may_not_fit_is_warned_of(caplog):
    assert choose_feature_mode("dense", PixelEncoder(), 1000, torch.bfloat16, 2**40)[0] == "dense"
    assert not caplog.records
    assert choose_feature_mode("dense", PixelEncoder(), 1000, torch.bfloat16, 2**20)[0] == "dense"
    assert "may not fit: 0.4 GiB for 1000 observations, 0.0 GiB free" in caplog.text


def test_explicit_modes_are_obeyed_or_refused():
    assert choose_feature_mode("reencode", PixelEncoder(), 1)[0] == "reencode"
    assert choose_feature_mode("dense", PixelEncoder(), 10**9, torch.float32, 1)[0] == "dense"
    with pytest.raises(ValueError, match="Flatten"):
        choose_feature_mode("dense", nn.Flatten(), 1)
    with pytest.raises(ValueError, match="cached"):
        choose_feature_mode("cached", PixelEncoder(), 1)


def test_embeddings_count_towards_the_memory_needed():
    needed = 1000 * 194_688 * 2
    assert (
        choose_feature_mode("auto", PixelEncoder(), 1000, torch.bfloat16, int(needed / 0.8) + 1)[0] == "dense"
    )
    mode, _ = choose_feature_mode(
        "auto", PixelEncoder(), 1000, torch.bfloat16, int(needed / 0.8) + 1, latent_dim=128
    )
    assert mode == "reencode"


def test_free_memory_is_measured_when_not_given():
    assert choose_feature_mode("auto", PixelEncoder(), 1)[0] == "dense"
    assert choose_feature_mode("auto", PixelEncoder(), 10**9)[0] == "reencode"

from __future__ import annotations

import pytest
import torch
from fake_pixel_env import SIZE, small_encoder
from torch import nn

from crptpro.modules import PixelEncoder
from crptpro.transforms import crop_features, dense_shift_geometry, dense_shift_maps, random_shift
from crptpro.transforms.dense_shift import _crop_by_index, crop_rows

ALL_SHIFTS = torch.cartesian_prod(torch.arange(9), torch.arange(9))


def trained(encoder):
    optimizer = torch.optim.Adam(encoder.parameters(), lr=1e-2)
    for _ in range(3):
        pixels = torch.randint(0, 256, (4, 9, encoder.image_size, encoder.image_size), dtype=torch.uint8)
        loss = (encoder(pixels) - 1).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return encoder


def greatest_error(encoder, pixels, dtype=None):
    """Largest difference to shift-then-encode over all 81 shifts, in units of the largest feature."""
    maps = dense_shift_maps(encoder, pixels.unsqueeze(0), dtype=dtype)
    crops = crop_features(maps.expand(81, *maps.shape[1:]), ALL_SHIFTS)
    with torch.no_grad():
        direct = encoder(random_shift(pixels.expand(81, *pixels.shape), ALL_SHIFTS))
    return ((crops.float() - direct.float()).abs().max() / direct.float().abs().max()).item()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"channels": (4, 4, 6, 5), "strides": (2, 1, 1, 1)},
        {"channels": (4, 6, 5), "strides": (2, 2, 1), "image_size": 25},
        {"strides": (1, 1)},
        {"strides": (3, 1), "image_size": 21},
        {"strides": (2, 2, 2), "channels": (4, 4, 4), "image_size": 32},
        {"pixel_offset": 0.5},
    ],
)
@pytest.mark.parametrize("weights", ["random", "trained"])
def test_dense_features_equal_shift_then_encode_for_every_shift(changes, weights):
    encoder = small_encoder(**changes)
    if weights == "trained":
        trained(encoder)
    pixels = torch.randint(0, 256, (9, encoder.image_size, encoder.image_size), dtype=torch.uint8)
    assert greatest_error(encoder, pixels) <= 1e-6


@pytest.mark.parametrize("channels_last", [True, False])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.bfloat16, 2**-8)])
def test_the_default_encoder_gives_all_81_shifts_at_full_size(dtype, tolerance, channels_last):
    encoder = PixelEncoder()
    encoder.compute_dtype, encoder.channels_last = dtype, channels_last
    pixels = torch.randint(0, 256, (9, 84, 84), dtype=torch.uint8)
    assert greatest_error(encoder, pixels) <= tolerance


def test_the_geometry_of_the_default_encoder_is_the_documented_one():
    geometry = dense_shift_geometry(PixelEncoder())
    assert geometry.maps_shape == (4, 32, 39, 39)
    assert (geometry.phases, geometry.window, geometry.feature_dim) == (2, 92, 39_200)
    assert geometry.values == 194_688


@pytest.mark.parametrize("pad", [0, 1, 3, 4])
def test_other_paddings_hold_too(pad):
    encoder = small_encoder(strides=(1, 1) if pad == 0 else (2, 1))
    side = torch.arange(2 * pad + 1)
    offsets = torch.cartesian_prod(side, side)
    pixels = torch.randint(0, 256, (len(offsets), 9, SIZE, SIZE), dtype=torch.uint8)
    with torch.no_grad():
        direct = encoder(random_shift(pixels, offsets, pad=pad))
    crops = crop_features(dense_shift_maps(encoder, pixels, pad=pad), offsets, pad=pad)
    torch.testing.assert_close(crops, direct, rtol=0, atol=1e-6 * float(direct.max()))


def test_float_pixels_give_the_same_maps_as_bytes():
    encoder = small_encoder()
    pixels = torch.randint(0, 256, (2, 9, SIZE, SIZE), dtype=torch.uint8)
    assert torch.equal(dense_shift_maps(encoder, pixels), dense_shift_maps(encoder, pixels.float()))


def test_maps_carry_no_gradient_and_have_the_dtype_asked_for():
    maps = dense_shift_maps(small_encoder(), torch.rand(1, 9, SIZE, SIZE), dtype=torch.bfloat16)
    assert not maps.requires_grad
    assert maps.dtype == torch.bfloat16
    assert maps.is_contiguous()


def test_indexing_as_on_a_gpu_gives_the_same_crops_as_slicing():
    maps = torch.randn(7, 4, 3, 11, 12)
    rows, offsets = torch.randint(0, 7, (81,)), ALL_SHIFTS
    indexed = _crop_by_index(maps, rows, offsets, 2, (5, 7, 8))
    assert torch.equal(indexed, crop_rows(maps, rows, offsets))


def test_crops_can_be_written_into_a_given_tensor():
    maps = torch.randn(2, 4, 3, 9, 9).bfloat16()
    out = torch.empty(2, 3 * 5 * 5, dtype=torch.bfloat16)
    rows, offsets = torch.tensor([1, 0]), torch.tensor([[0, 8], [3, 2]])
    assert crop_rows(maps, rows, offsets, out=out) is out
    assert torch.equal(out, crop_rows(maps, rows, offsets))
    with pytest.raises(ValueError, match="out"):
        crop_rows(maps, rows, offsets, out=out.float())


@pytest.mark.parametrize("into", ["new", "given"])
def test_crops_of_bfloat16_maps_come_in_float32_with_the_same_values(into: str):
    maps = torch.randn(7, 4, 3, 11, 12).bfloat16()
    maps[0, 0, 0, 0, :4] = torch.tensor([-0.0, torch.inf, -torch.inf, 1e-40])
    rows, offsets = torch.randint(0, 7, (81,)), ALL_SHIFTS
    out = torch.full((81, 3 * 7 * 8), torch.nan) if into == "given" else None
    crops = crop_rows(maps, rows, offsets, out=out, dtype=torch.float32)
    assert crops.dtype == torch.float32
    expected = crop_rows(maps, rows, offsets).float()
    assert torch.equal(crops.view(torch.int32), expected.view(torch.int32))


@pytest.mark.parametrize(
    ("maps", "features"), [("float32", "bfloat16"), ("bfloat16", "float64"), ("float32", "float64")]
)
def test_maps_are_read_in_no_other_format(maps: str, features: str):
    store = torch.zeros(1, 4, 3, 9, 9, dtype=getattr(torch, maps))
    where = torch.tensor([0]), torch.tensor([[0, 0]])
    with pytest.raises(ValueError, match=f"maps in torch.{maps} .* got torch.{features}"):
        crop_rows(store, *where, dtype=getattr(torch, features))


def test_encoders_of_another_form_are_refused_with_the_remedy():
    with pytest.raises(ValueError, match="reencode"):
        dense_shift_geometry(nn.Conv2d(9, 4, 3, padding=1))
    with pytest.raises(ValueError, match="total stride 16"):
        dense_shift_geometry(small_encoder(strides=(4, 4), image_size=40))


def test_wrong_pixels_and_offsets_are_refused():
    encoder = small_encoder()
    with pytest.raises(ValueError, match="pixels"):
        dense_shift_maps(encoder, torch.zeros(1, 9, SIZE + 1, SIZE))
    maps = dense_shift_maps(encoder, torch.zeros(1, 9, SIZE, SIZE))
    with pytest.raises(ValueError, match=r"0\.\.8"):
        crop_features(maps, torch.tensor([[9, 0]]))
    with pytest.raises(ValueError, match="offsets"):
        crop_features(maps, torch.tensor([[0, 0], [1, 1]]))

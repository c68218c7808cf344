"""Features of all 81 random shifts of an image as crops of a few dense maps: the same numbers, encoded once.

An un-padded convolutional encoder with total stride S sees a shifted image as a crop of what it would make
of the larger, border-replicated image. Shifts that differ by a multiple of S share one map, so one map per
remainder ("phase") holds them all: the shift (dy, dx) is the crop at (dy // S, dx // S) of the map of phase
(dy % S, dx % S). The identity is the shift-and-stitch of OverFeat (Sermanet et al. 2013,
https://arxiv.org/abs/1312.6229). For the default encoder (84x84, strides 2, 1, 1, 1) and 4 pixels of shift:
4 maps of 32x39x39, crops of 32x35x35.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.host_memory import as_numpy_bits, empty_batch
from crptpro.modules import PixelEncoder
from crptpro.modules.chunks import split_among_threads
from crptpro.transforms.random_shift import check_offsets


@dataclass(frozen=True)
class DenseShiftGeometry:
    """Sizes that follow from an encoder and a largest shift.

    Attributes:
        phases: phases per axis, the encoder's total stride (2), at most ``2 * pad + 1``.
        window: side in pixels of the image that each phase encodes (92).
        maps_shape: ``(phases**2, C, m, m)`` of the dense maps of one image (4, 32, 39, 39).
        feature_dim: length of one crop, flattened (39,200).
    """

    phases: int
    window: int
    maps_shape: tuple[int, int, int, int]
    feature_dim: int

    @property
    def values(self) -> int:
        """Numbers stored per image (194,688)."""
        return math.prod(self.maps_shape)


def dense_shift_geometry(encoder: nn.Module, pad: int = 4) -> DenseShiftGeometry:
    """Work out the dense maps of an encoder.

    Args:
        encoder: a :class:`~crptpro.modules.PixelEncoder` with any strides.
        pad: largest shift in pixels, in each direction.

    Raises:
        ValueError: the encoder is not known to be un-padded and convolutional throughout, or its stride
            leaves no shifts to share (then encoding every shift by itself costs the same).
    """
    if not isinstance(encoder, PixelEncoder):
        raise ValueError(
            f"dense-shift features need an un-padded convolutional PixelEncoder, "
            f"got {type(encoder).__name__}; use mode 'reencode'."
        )
    stride = math.prod(encoder.strides)
    if stride > 2 * pad + 1:
        raise ValueError(
            f"the encoder's total stride {stride} exceeds the {2 * pad + 1} shifts per axis of pad {pad}; "
            f"use mode 'reencode'."
        )
    channels, height, width = encoder.feature_map_shape
    extra = 2 * pad // stride
    return DenseShiftGeometry(
        phases=stride,
        window=encoder.image_size + stride * extra,
        maps_shape=(stride**2, channels, height + extra, width + extra),
        feature_dim=encoder.feature_dim,
    )


@torch.no_grad()
def dense_shift_maps(
    encoder: PixelEncoder, pixels: Tensor, *, pad: int = 4, dtype: torch.dtype | None = None
) -> Tensor:
    """Encode images once per stride phase, border replicated, for every shift of up to ``pad`` pixels.

    Args:
        encoder: see :func:`dense_shift_geometry`.
        pixels: ``[B, in_channels, image_size, image_size]``, uint8 or floating, values 0..255.
        pad: largest shift in pixels.
        dtype: of the result; the encoder's compute dtype by default.

    Returns:
        ``[B, phases**2, C, m, m]`` contiguous, phases ordered (row, column); without gradient. For the
        default encoder ``[B, 4, 32, 39, 39]``.

    Raises:
        ValueError: an encoder that is not of this form, or pixels of another shape.
    """
    geometry = dense_shift_geometry(encoder, pad)
    expected = (encoder.in_channels, encoder.image_size, encoder.image_size)
    if pixels.ndim != 4 or tuple(pixels.shape[1:]) != expected:
        raise ValueError(f"expected pixels of shape [B, {expected}], got {tuple(pixels.shape)}.")
    # The last phase's window ends beyond the padded image; no crop that is ever read depends on those lines.
    overhang = geometry.phases - 1 + geometry.window - (encoder.image_size + 2 * pad)
    far = pad + max(0, overhang)
    padded = F.pad(pixels, (pad, far, pad, far), mode="replicate")
    windows = torch.stack(
        [
            padded[:, :, row : row + geometry.window, column : column + geometry.window]
            for row in range(geometry.phases)
            for column in range(geometry.phases)
        ],
        dim=1,
    )
    maps = encoder.feature_map(windows)
    return maps.to(dtype=maps.dtype if dtype is None else dtype, memory_format=torch.contiguous_format)


def crop_features(maps: Tensor, offsets: Tensor, *, pad: int = 4) -> Tensor:
    """Read the features of one shift per image from its dense maps.

    Equal to ``encoder(random_shift(pixels, offsets, pad=pad))``: bit for bit in float32 where the
    convolution adds up each output in an order that does not depend on the image size (oneDNN on x86 does),
    otherwise to the rounding of the convolution (about 1e-6 of the largest feature).

    Args:
        maps: ``[B, phases**2, C, m, m]`` of :func:`dense_shift_maps`.
        offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.
        pad: as given to :func:`dense_shift_maps`.

    Returns:
        ``[B, feature_dim]`` in the (C, H, W) order of :class:`~crptpro.modules.PixelEncoder`.

    Raises:
        ValueError: an offset outside the range (read on the CPU only).
    """
    return crop_rows(maps, torch.arange(maps.shape[0], device=maps.device), offsets, pad=pad)


@torch.no_grad()
def crop_rows(
    maps: Tensor,
    rows: Tensor,
    offsets: Tensor,
    *,
    pad: int = 4,
    out: Tensor | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Crop row ``rows[i]`` of a store of maps at ``offsets[i]``.

    On a CPU each crop is one slice copy; elsewhere it is one indexing kernel on an overlapping view of the
    store, without host synchronisation.

    Args:
        maps: contiguous ``[N, phases**2, C, m, m]``.
        rows: int64 ``[B]``.
        offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.
        pad: as given to :func:`dense_shift_maps`.
        out: contiguous ``[B, feature_dim]`` of ``dtype`` to write into. Reusing one halves the time on a CPU, where
            the rest goes into mapping fresh memory.
        dtype: of the crops: that of the maps when None, or float32 of bfloat16 maps.

    Returns:
        ``[B, feature_dim]``; ``out`` if given.

    Raises:
        ValueError: shapes or formats that do not fit, or an offset outside the range (read on the CPU only).
    """
    dtype = maps.dtype if dtype is None else dtype
    require_readable(maps.dtype, dtype)
    batch, channels = rows.shape[0], maps.shape[2]
    if offsets.shape != (batch, 2):
        raise ValueError(f"expected offsets of shape [{batch}, 2], got {tuple(offsets.shape)}.")
    check_offsets(offsets, pad)
    phases = math.isqrt(maps.shape[1])
    extra = 2 * pad // phases
    height, width = maps.shape[-2] - extra, maps.shape[-1] - extra
    shape = (batch, channels * height * width)
    if out is not None and (out.shape != shape or out.dtype != dtype):
        raise ValueError(f"expected out of shape {shape} and {dtype}, got {tuple(out.shape)}, {out.dtype}.")
    if maps.device.type != "cpu":
        crops = _crop_by_index(maps, rows, offsets, phases, (extra + 1, height, width))
        return crops.to(dtype) if out is None else out.copy_(crops)
    # Channels first although channels last would copy in longer runs: the features must come in (C, H, W)
    # order, and turning a batch around costs three times the whole copy.
    crops = empty_batch(shape, dtype) if out is None else out
    source = as_numpy_bits(maps)
    widens = dtype != maps.dtype
    target = crops.view(torch.int32).numpy() if widens else as_numpy_bits(crops)
    target = target.reshape(batch, channels, height, width)
    where = list(zip(rows.tolist(), offsets.tolist()))

    def crop_part(part: slice) -> None:
        for crop, (row, (dy, dx)) in zip(target[part], where[part]):
            top, left = dy // phases, dx // phases
            phase = dy % phases * phases + dx % phases
            crop[:] = source[row, phase, :, top : top + height, left : left + width]
            if widens:
                crop <<= 16  # the bits of a bfloat16 are the upper half of the same number's in float32

    split_among_threads(crop_part, batch)
    return crops


def _crop_by_index(
    maps: Tensor, rows: Tensor, offsets: Tensor, phases: int, sizes: tuple[int, int, int]
) -> Tensor:
    origins, height, width = sizes
    slots, phase_count, channels = maps.shape[:3]
    row_stride, phase_stride, channel_stride, line, column = maps.stride()
    every_crop = maps.as_strided(
        (slots, phase_count, origins, origins, channels, height, width),
        (row_stride, phase_stride, line, column, channel_stride, line, column),
    )
    rows, offsets = rows.to(maps.device), offsets.to(maps.device)
    origin, remainder = offsets // phases, offsets % phases
    phase = remainder[:, 0] * phases + remainder[:, 1]
    return every_crop[rows, phase, origin[:, 0], origin[:, 1]].flatten(1)


def require_readable(maps: torch.dtype, features: torch.dtype) -> None:
    """Refuse to read maps of one format as features of another, except bfloat16 as float32.

    Raises:
        ValueError: naming both.
    """
    if features != maps and (maps, features) != (torch.bfloat16, torch.float32):
        raise ValueError(f"maps in {maps} are read as {maps}, or bfloat16 as float32; got {features}.")

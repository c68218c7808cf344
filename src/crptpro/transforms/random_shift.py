"""Random shift, the image augmentation of all methods: exact on integer offsets and fast on a CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from crptpro.transforms.base import Keys, PixelTransform
from crptpro.values import as_int


def draw_offsets(
    batch: int, pad: int, generator: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> Tensor:
    """Draw one shift per sample, uniform over the ``(2 * pad + 1)**2`` integer offsets of up to ``pad`` pixels.

    Returns int64 ``[batch, 2]``, (row, column) in ``{0, ..., 2 * pad}``; a CPU generator gives the same everywhere.
    """
    source = torch.device(device) if generator is None else generator.device
    return torch.randint(0, 2 * pad + 1, (batch, 2), generator=generator, device=source).to(device)


def random_shift(pixels: Tensor, offsets: Tensor, *, pad: int = 4) -> Tensor:
    """Crop every image ``[B, C, H, W]``, its border replicated ``pad`` times, at its own integer offset ``[B, 2]``.

    This is the augmentation of DrQ (denisyarats/drq) as CRPTpro and Proto-RL use it. Offsets are (row, column) in
    ``{0, ..., 2 * pad}``; others on a CPU raise a ``ValueError``. Values are copied, never interpolated: on a CPU by
    slices, in half the time of padding and cropping; on other devices, under ``torch.compile`` and for a gradient by
    one gather without host synchronisation.

    Examples:
        >>> image = torch.arange(4).view(1, 1, 2, 2)
        >>> random_shift(image, torch.tensor([[0, 1]]), pad=1)  # up by one row
        tensor([[[[0, 1],
                  [0, 1]]]])
    """
    if pixels.ndim != 4 or offsets.shape != (pixels.shape[0], 2):
        raise ValueError(
            f"random_shift expects pixels [B, C, H, W] and offsets [B, 2], "
            f"got {tuple(pixels.shape)} and {tuple(offsets.shape)}."
        )
    if torch.compiler.is_compiling():
        return _shift_by_gather(pixels, offsets, pad)
    if offsets.device.type == "cpu" and offsets.numel():
        low, high = (int(bound) for bound in torch.aminmax(offsets))
        if low < 0 or high > 2 * pad:
            raise ValueError(f"offsets must lie in 0..{2 * pad} (pad {pad}), got {low}..{high}.")
    if pixels.device.type != "cpu" or pixels.requires_grad:
        return _shift_by_gather(pixels, offsets, pad)
    return _shift_by_slices(pixels, offsets, pad)


def as_numpy_bits(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return a numpy array over the same memory, for copies only: numpy has no bfloat16, so it is int16."""
    return (tensor.view(torch.int16) if tensor.dtype == torch.bfloat16 else tensor).numpy()


def _shift_by_gather(pixels: Tensor, offsets: Tensor, pad: int) -> Tensor:
    batch, channels, height, width = pixels.shape
    device = pixels.device
    offsets = offsets.to(device) - pad
    rows = (torch.arange(height, device=device) + offsets[:, :1]).clamp(0, height - 1)
    columns = (torch.arange(width, device=device) + offsets[:, 1:]).clamp(0, width - 1)
    samples = torch.arange(batch, device=device)[:, None, None, None]
    planes = torch.arange(channels, device=device)[:, None, None]
    return pixels[samples, planes, rows[:, None, :, None], columns[:, None, None, :]]


def _shift_by_slices(pixels: Tensor, offsets: Tensor, pad: int) -> Tensor:
    shifted = torch.empty(pixels.shape, dtype=pixels.dtype, device=pixels.device)
    source, target = as_numpy_bits(pixels.detach()), as_numpy_bits(shifted)
    for image, view, offset in zip(source, target, (offsets - pad).tolist()):
        _copy_shifted(view, image, *offset)
    return shifted


def _copy_shifted(view: np.ndarray[Any, Any], image: np.ndarray[Any, Any], row: int, column: int) -> None:
    # Copies the visible part, then repeats its outermost columns and rows: one pass over the data, not two.
    height, width = image.shape[-2:]
    row, column = max(min(row, height - 1), 1 - height), max(min(column, width - 1), 1 - width)
    top, bottom = max(-row, 0), height - max(row, 0)
    left, right = max(-column, 0), width - max(column, 0)
    rows = slice(top + row, bottom + row)
    view[:, top:bottom, left:right] = image[:, rows, left + column : right + column]
    view[:, top:bottom, :left] = image[:, rows, :1]
    view[:, top:bottom, right:] = image[:, rows, -1:]
    view[:, :top] = view[:, top : top + 1]
    view[:, bottom:] = view[:, bottom - 1 : bottom]


class RandomShift(PixelTransform):
    """Shift images ``[*, C, H, W]`` at random by up to ``pad`` pixels, for replay buffers and environments.

    Every key and every sample draws its own offset, common to all channels (stacked frames). The transform acts in
    evaluation mode too, into which TorchRL puts every attached transform.

    ``in_keys`` are ``["pixels", ("next", "pixels")]`` in a replay buffer of transitions, ``["pixels"]`` on an
    environment. Without ``out_keys`` the images are replaced. Clones share the ``generator`` of the offsets (torch's
    global one if None), and the state dict excludes it.
    """

    def __init__(
        self, in_keys: Keys, out_keys: Keys | None = None, *, pad: int = 4, generator: torch.Generator | None = None
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.pad = as_int(pad, "pad", minimum=0)
        self.generator = generator

    def _apply_transform(self, obs: Tensor) -> Tensor:
        images = obs.reshape(-1, *obs.shape[-3:])
        offsets = draw_offsets(images.shape[0], self.pad, self.generator, images.device)
        return random_shift(images, offsets, pad=self.pad).reshape(obs.shape)

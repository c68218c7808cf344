"""Random shift: the one image augmentation of the method, exact on integer offsets and fast on a CPU."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from crptpro.transforms.base import Keys, PixelTransform
from crptpro.values import as_int


def draw_offsets(
    batch: int, pad: int, generator: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> Tensor:
    """Draw one shift per sample, uniform over the ``(2 * pad + 1)**2`` integer offsets.

    Args:
        batch: number of samples.
        pad: largest shift in pixels, in each direction.
        generator: source of the draws; torch's global generator of ``device`` when None. A generator on
            another device is drawn from where it lives, so one CPU generator gives the same shifts on every
            device.
        device: where the offsets are returned.

    Returns:
        int64 ``[batch, 2]``, (row, column), each in ``{0, ..., 2 * pad}``; ``(pad, pad)`` is no shift.
    """
    source = torch.device(device) if generator is None else generator.device
    return torch.randint(0, 2 * pad + 1, (batch, 2), generator=generator, device=source).to(device)


def random_shift(pixels: Tensor, offsets: Tensor, *, pad: int = 4) -> Tensor:
    """Shift every image by its own integer offset, repeating the border where nothing was.

    A crop of the image with its border replicated ``pad`` times: the augmentation of DrQ
    (denisyarats/drq) as CRPTpro and Proto-RL use it for pre-training and downstream RL.
    Values are copied, never interpolated, so the result is exact in every dtype.

    On a CPU this copies slices. On other devices and under ``torch.compile`` it is one gather without host
    synchronisation.

    Args:
        pixels: ``[B, C, H, W]``, any dtype.
        offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``, shared by all channels of a sample.
        pad: width of the replicated border.

    Returns:
        ``[B, C, H, W]``, same dtype and device.

    Raises:
        ValueError: shapes that do not fit, or an offset outside ``{0, ..., 2 * pad}`` (offsets on the CPU;
            not under ``torch.compile``).

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
    if not torch.compiler.is_compiling():
        check_offsets(offsets, pad)
    if torch.compiler.is_compiling() or pixels.device.type != "cpu" or not len(pixels):
        return _shift_by_gather(pixels, offsets, pad)
    height, width = pixels.shape[-2:]
    padded = F.pad(pixels, (pad,) * 4, mode="replicate")
    crops = zip(padded, offsets.tolist())
    return torch.stack([image[:, top : top + height, left : left + width] for image, (top, left) in crops])


def check_offsets(offsets: Tensor, pad: int) -> None:
    """Refuse offsets outside ``{0, ..., 2 * pad}``; offsets on other devices are not read (that would wait).

    Raises:
        ValueError: naming the smallest and largest offset.
    """
    if offsets.device.type != "cpu" or offsets.numel() == 0:
        return
    low, high = (int(bound) for bound in torch.aminmax(offsets))
    if low < 0 or high > 2 * pad:
        raise ValueError(f"offsets must lie in 0..{2 * pad} (pad {pad}), got {low}..{high}.")


def _shift_by_gather(pixels: Tensor, offsets: Tensor, pad: int) -> Tensor:
    batch, channels, height, width = pixels.shape
    device = pixels.device
    offsets = offsets.to(device) - pad
    rows = (torch.arange(height, device=device) + offsets[:, :1]).clamp(0, height - 1)
    columns = (torch.arange(width, device=device) + offsets[:, 1:]).clamp(0, width - 1)
    samples = torch.arange(batch, device=device)[:, None, None, None]
    planes = torch.arange(channels, device=device)[:, None, None]
    return pixels[samples, planes, rows[:, None, :, None], columns[:, None, None, :]]


class RandomShift(PixelTransform):
    """Shift images at random, for replay buffers (``forward``) and environments.

    Every key and every sample draws its own offset; all channels (stacked frames) of a sample share it. The
    transform acts whether or not it is in training mode, because TorchRL puts every attached transform into
    evaluation mode. On an environment only the root keys are shifted.

    Args:
        pad: largest shift in pixels.
        in_keys: uint8 or float images ``[*, C, H, W]``. By default ``"pixels"`` and, where present,
            ``("next", "pixels")``; keys that are named must be present.
        out_keys: where the shifted images go; in place of the originals by default.
        generator: source of the offsets; torch's global generator when None. It is not part of the state
            dict: whoever owns it saves it. Clones of the transform share it.

    Raises:
        ValueError: negative ``pad``, or ``in_keys`` and ``out_keys`` of unequal length.

    """

    def __init__(
        self,
        pad: int = 4,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.pad = as_int(pad, "pad", minimum=0)
        self.generator = generator

    def _apply_transform(self, obs: Tensor) -> Tensor:
        images = obs.reshape(-1, *obs.shape[-3:])
        offsets = draw_offsets(images.shape[0], self.pad, self.generator, images.device)
        return random_shift(images, offsets, pad=self.pad).reshape(obs.shape)

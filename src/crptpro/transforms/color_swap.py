"""Images with their colour channels in reverse order."""

from __future__ import annotations

from torch import Tensor

from crptpro.transforms.base import Keys, PixelTransform

CHANNELS = 3


def swap_colors(pixels: Tensor) -> Tensor:
    """Reverse the channel order, RGB to BGR, of every frame of a stack; twice gives the images back.

    Args:
        pixels: ``[*, 3 k, H, W]`` of k frames, any dtype.

    Returns:
        The same shape and dtype; a copy.

    Raises:
        ValueError: if the channels are no whole number of RGB frames.

    Examples:
        >>> import torch
        >>> swap_colors(torch.tensor([1, 2, 3, 4, 5, 6]).view(6, 1, 1)).flatten().tolist()
        [3, 2, 1, 6, 5, 4]
    """
    if pixels.ndim < 3 or pixels.shape[-3] % CHANNELS:
        raise ValueError(f"swap_colors expects RGB frames [*, 3 k, H, W], got {tuple(pixels.shape)}.")
    return pixels.unflatten(-3, (-1, CHANNELS)).flip(-3).flatten(-4, -3)


class ColorSwap(PixelTransform):
    """Reverses the channel order of whole images: the simplest reading of the paper's unseen colours.

    Everything changes its colour with it, the robot too; ``make_env(..., colors="reversed_background")`` changes the
    background alone. Works on RGB frames and on stacks of them, in environments and on replay batches.

    Args:
        in_keys: images ``[*, 3 k, H, W]``; ``pixels`` and ``("next", "pixels")`` if None.
        out_keys: where they go; in place if None.

    Raises:
        ValueError: ``out_keys`` that do not pair with ``in_keys``.
    """

    def __init__(self, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        super().__init__(in_keys, out_keys)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return swap_colors(obs)

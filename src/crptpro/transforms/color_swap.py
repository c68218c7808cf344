"""Images with their colour channels in reverse order."""

from __future__ import annotations

from torch import Tensor

from crptpro.transforms.base import PixelTransform


class ColorSwap(PixelTransform):
    """Reverses the channel order, RGB to BGR, of whole images: the simplest reading of the paper's unseen colours.

    ``make_env(..., colors="reversed_background")`` changes the background alone. For environments and replay batches,
    of RGB frames and stacks of them, ``[*, 3 k, H, W]``; keys as in :class:`RandomShift`.
    """

    def _apply_transform(self, obs: Tensor) -> Tensor:
        if obs.ndim < 3 or obs.shape[-3] % 3:
            raise ValueError(f"ColorSwap expects RGB frames [*, 3 k, H, W], got {tuple(obs.shape)}.")
        return obs.unflatten(-3, (-1, 3)).flip(-3).flatten(-4, -3)

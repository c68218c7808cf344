"""Images with their colour channels in reverse order."""

from __future__ import annotations

from torch import Tensor

from crptpro.transforms.base import Keys, PixelTransform

CHANNELS = 3


class ColorSwap(PixelTransform):
    """Reverses the channel order, RGB to BGR, of whole images: the simplest reading of the paper's unseen colours.

    ``make_env(..., colors="reversed_background")`` changes the background alone. For environments and replay batches,
    of RGB frames and stacks of them, ``[*, 3 k, H, W]``; keys as in :class:`RandomShift`.
    """

    def __init__(self, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        super().__init__(in_keys, out_keys)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        if obs.ndim < 3 or obs.shape[-3] % CHANNELS:
            raise ValueError(f"ColorSwap expects RGB frames [*, 3 k, H, W], got {tuple(obs.shape)}.")
        return obs.unflatten(-3, (-1, CHANNELS)).flip(-3).flatten(-4, -3)

"""Batches of one domain's replay: every image under a random shift of its own, then encoded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import nn

from crptpro.data import FrameReplay
from crptpro.seeding import derive_seed
from crptpro.transforms.random_shift import draw_offsets, random_shift

PIXELS: tuple[NestedKey, ...] = ("pixels", ("next", "pixels"))


class ReplayBatches:
    """Draws augmented batches from a domain's replay.

    Args:
        replay: of the domain; draws from a generator of this object's from now on.
        seed: seeds the draws and the shifts (on the CPU, so that every device sees the same ones).
        pad: largest shift in pixels.
        device: where batches go.
        views: image entries to make as second, independently shifted views, with what they are views of.
        n_step: decisions that the return looks ahead; 1 for single transitions.
        discount: per decision, for ``n_step`` above 1.
    """

    def __init__(
        self,
        replay: FrameReplay,
        *,
        seed: int,
        pad: int,
        device: torch.device,
        views: Mapping[NestedKey, NestedKey],
        n_step: int = 1,
        discount: float = 0.99,
    ) -> None:
        self.replay, self.pad, self.device = replay, pad, device
        self.sources = {**{key: key for key in PIXELS}, **views}
        self.options: dict[str, Any] = {} if n_step == 1 else {"n_step": n_step, "discount": discount}
        self.generators = {
            name: torch.Generator().manual_seed(derive_seed(seed, name)) for name in ("draws", "shifts")
        }
        replay.set_rng(self.generators["draws"])

    def sample(self, batch_size: int) -> TensorDictBase:
        """Draw a batch of transitions with every image entry shifted, on the device.

        Args:
            batch_size: transitions.
        """
        batch = self.replay.sample(batch_size, **self.options).to(self.device)
        originals = {key: batch.get(key) for key in PIXELS}
        for key in sorted(self.sources, key=str):
            pixels = originals[self.sources[key]]
            offsets = draw_offsets(len(pixels), self.pad, self.generators["shifts"], pixels.device)
            batch.set(key, random_shift(pixels, offsets, pad=self.pad))
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Return the generators' states."""
        return {name: generator.get_state() for name, generator in self.generators.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        for name, generator in self.generators.items():
            generator.set_state(state[name])


def features_key(pixels_key: NestedKey) -> NestedKey:
    """Return the key of an image entry's features.

    Examples:
        >>> features_key(("next", "pixels_view"))
        ('next', 'features_view')
    """
    *lead, last = (pixels_key,) if isinstance(pixels_key, str) else pixels_key
    return unravel_key((*lead, str(last).replace("pixels", "features")))


@torch.no_grad()
def encode(batch: TensorDictBase, encoder: nn.Module, keys: Sequence[NestedKey]) -> None:
    """Set the features of each image entry in ``keys`` beside it, without gradient.

    Args:
        batch: with uint8 images ``[B, C, H, W]``; gains ``[B, feature_dim]`` per entry.
        encoder: images to features.
        keys: image entries.
    """
    for key in keys:
        batch.set(features_key(key), encoder(batch.get(key)))

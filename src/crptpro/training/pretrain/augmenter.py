"""Random shifts of what a pre-training run draws, and second views of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from crptpro.seeding import derive_seed
from crptpro.training.pretrain.sources import SHIFT_PAD, Source
from crptpro.transforms.random_shift import draw_offsets, random_shift

_LOG = logging.getLogger(__name__)

Augment = Literal["random_shift", "none"] | Callable[[TensorDictBase, torch.Generator], TensorDictBase]


class Augmenter:
    """Random shift of every image entry, each with its own offsets, from its own generator.

    Args:
        augment: ``"random_shift"``, ``"none"``, or ``f(batch, generator) -> batch``; a function gets the views as
            copies of what they are views of.
        seed: seeds the generator (on the CPU, so that every device sees the same shifts).
        views: entries that the loss reads as a second view of another one: ``{"pixels_view": "pixels"}``. They
            are made of the same images, shifted once more.
    """

    def __init__(
        self, augment: Augment, *, seed: int, views: Mapping[NestedKey, NestedKey] | None = None
    ) -> None:
        if augment not in ("random_shift", "none") and not callable(augment):
            raise ValueError(f"`augment` must be 'random_shift', 'none' or a function, got {augment!r}.")
        self.augment = augment
        self.views = dict(sorted((views or {}).items(), key=lambda item: str(item[0])))
        self.generator = torch.Generator().manual_seed(derive_seed(seed, "pretrain", "augment"))
        self._is_warned = False

    @property
    def name(self) -> str:
        """For cards and fingerprints."""
        return self.augment if isinstance(self.augment, str) else getattr(self.augment, "__name__", "own")

    def sample(
        self,
        source: Source,
        batch_size: int,
        keys: Sequence[NestedKey] | None,
        device: torch.device | str = "cpu",
    ) -> TensorDictBase:
        """Draw an augmented batch, the same one whichever way is open.

        Args:
            source: where to draw.
            batch_size: transitions.
            keys: entries that the loss reads, views included; all of the dataset if ``None``.
            device: where the batch is returned.

        Raises:
            DatasetError: if the dataset lacks one of the keys, or what a view is made of.
        """
        if keys is not None and self.views:
            # No dataset holds a view; it holds what the view is made of.
            keys = list(dict.fromkeys(self.views.get(key, key) for key in keys))
        if self.augment == "random_shift" and source.is_shifted_when_read:
            return source.sample_shifted(batch_size, keys, self.generator, self.views).to(device)
        return self(source.sample(batch_size, keys).to(device))

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Augment a batch of a dataset's entries and add the views, in place for the built-in shift."""
        seen = {view: batch.get(key) for view, key in self.views.items()}
        if self.augment != "random_shift":
            for view, pixels in seen.items():
                batch.set(view, pixels.clone())
            return batch if isinstance(self.augment, str) else self.augment(batch, self.generator)
        entries = sorted(batch.items(True, True), key=lambda item: str(item[0]))
        images = {key: value for key, value in entries if value.ndim >= 4}
        # Images that the dataset has transformed in its own way are not shifted, nor is a view of them.
        keys = [key for key, value in images.items() if value.dtype == torch.uint8]
        self._warn_of_others({key: value.dtype for key, value in images.items() if key not in keys})
        for key in keys:
            batch.set(key, self._shift(batch.get(key)))
        for view, pixels in seen.items():
            batch.set(view, self._shift(pixels) if self.views[view] in keys else pixels.clone())
        return batch

    def _warn_of_others(self, dtypes: Mapping[NestedKey, torch.dtype]) -> None:
        if dtypes and not self._is_warned:
            self._is_warned = True
            named = ", ".join(f"{key!r} ({dtype})" for key, dtype in dtypes.items())
            _LOG.warning(
                "random_shift moves uint8 images; %s is learned from as the dataset gives it. Store bytes, or pass "
                "augment=a function of batch and generator.",
                named,
            )

    def _shift(self, pixels: Tensor) -> Tensor:
        images = pixels.reshape(-1, *pixels.shape[-3:])
        offsets = draw_offsets(images.shape[0], SHIFT_PAD, self.generator, images.device)
        return random_shift(images, offsets, pad=SHIFT_PAD).reshape(pixels.shape)

"""The datasets of a pre-training run: named, seeded one by one, and augmented."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from crptpro.data import FrameDataset
from crptpro.errors import DatasetError
from crptpro.seeding import derive_seed
from crptpro.transforms.random_shift import draw_offsets, random_shift, shifted_stacks

_LOG = logging.getLogger(__name__)

Augment = Literal["random_shift", "none"] | Callable[[TensorDictBase, torch.Generator], TensorDictBase]
SHIFT_PAD = 4
_CARD_FACTS = (
    "domain", "task", "transitions", "episodes", "frame_stack", "action_repeat", "image_size", "seed",
    "quality", "colors", "backend",
)  # fmt: skip


class Source:
    """One domain's dataset with its own generator.

    Args:
        name: the domain, unique within the run.
        dataset: anything with ``sample(batch_size) -> TensorDict``; ``set_rng`` makes it repeatable.
        seed: seeds the sampling.
    """

    def __init__(self, name: str, dataset: Any, *, seed: int) -> None:
        self.name = name
        self.dataset = dataset
        storage = getattr(dataset, "_storage", None)
        device = getattr(storage, "device", "cpu")
        self.generator = torch.Generator(device if isinstance(device, (torch.device, str)) else "cpu")
        self.generator.manual_seed(derive_seed(seed, "pretrain", "sample", name))
        if hasattr(dataset, "set_rng"):
            dataset.set_rng(self.generator)
        else:
            _LOG.warning("The dataset %r has no set_rng: its samples are not reproducible.", name)

    def sample(self, batch_size: int, keys: Sequence[NestedKey] | None) -> TensorDictBase:
        """Draw a batch, reduced to the entries the loss reads.

        Raises:
            DatasetError: if the batch lacks one of them.
        """
        return self._select(self.dataset.sample(batch_size), keys)

    @property
    def is_shifted_when_read(self) -> bool:
        """Whether :meth:`sample_shifted` can be used: frames of ours on the CPU, sampled as they are."""
        dataset = self.dataset
        return (
            type(dataset) is FrameDataset
            and dataset.is_read_directly
            and dataset.frames.get("pixels").device.type == "cpu"
        )

    def sample_shifted(
        self,
        batch_size: int,
        keys: Sequence[NestedKey] | None,
        generator: torch.Generator,
        views: Mapping[NestedKey, NestedKey] | None = None,
    ) -> TensorDictBase:
        """Draw what :meth:`sample` draws, its stacks shifted while they are read from the frames.

        Args:
            batch_size: transitions.
            keys: entries that the loss reads from the dataset; all if ``None``.
            generator: source of the offsets, one draw per stack entry in the order of their names, then one per
                view.
            views: further entries, each made of the stacks of the entry it names, with offsets of its own.

        Raises:
            DatasetError: if the dataset lacks one of the keys.
        """
        batch = self.dataset.sample(batch_size, pixels=False)
        frames, rows = self.dataset.frames.get("pixels"), self.dataset.stack_rows_of(batch)

        def shifted(key: NestedKey) -> Tensor:
            offsets = draw_offsets(len(rows[key]), SHIFT_PAD, generator)
            return shifted_stacks(frames, rows[key], offsets, pad=SHIFT_PAD)

        for key in sorted(rows, key=str):
            if keys is None or key in keys:
                batch.set(key, shifted(key))
        batch = self._select(batch, keys)
        for view, key in sorted((views or {}).items(), key=lambda item: str(item[0])):
            batch.set(view, shifted(key))
        return batch

    def _select(self, batch: TensorDictBase, keys: Sequence[NestedKey] | None) -> TensorDictBase:
        if keys is None:
            return batch
        held = set(batch.keys(True, True))
        for key in keys:
            if key not in held:
                names = ", ".join(sorted(str(k) for k in held))
                raise DatasetError(
                    f"The loss reads {key!r}, which the dataset {self.name!r} lacks; it has {names}."
                )
        return batch.select(*keys)

    def facts(self) -> dict[str, Any]:
        """Return what belongs into the card of the trained artifact."""
        card = getattr(self.dataset, "card", None) or {}
        facts = {name: card[name] for name in _CARD_FACTS if name in card}
        return {"domain": self.name, "transitions": _length(self.dataset), **facts}

    def identity(self) -> dict[str, Any]:
        """Return what must agree for a checkpoint to be continued with this dataset."""
        card = getattr(self.dataset, "card", None) or {}
        text = json.dumps(card, sort_keys=True, default=str)
        return {
            "name": self.name,
            "transitions": _length(self.dataset),
            "card": hashlib.sha256(text.encode()).hexdigest()[:16] if card else None,
            "sampled on": self.generator.device.type,
        }

    def require_fit(self, encoder: Any) -> None:
        """Refuse a dataset whose card names other images than the encoder takes.

        Raises:
            DatasetError: naming both forms. Datasets without a card, and encoders that do not say, pass.
        """
        card = getattr(self.dataset, "card", None) or {}
        has = (card.get("image_size"), card.get("frame_stack"))
        channels = getattr(encoder, "in_channels", None)
        wants = (getattr(encoder, "image_size", None), None if channels is None else channels // 3)
        if None not in (*has, *wants) and has != wants:
            raise DatasetError(
                f"The dataset {self.name!r} has stacks of {has[1]} images of {has[0]} px; the encoder takes "
                f"{wants[1]} of {wants[0]} px. Collect with those, or build the encoder for the dataset."
            )

    def state_dict(self) -> dict[str, Any]:
        """Return the state of generator and sampler."""
        return {"generator": self.generator.get_state(), "sampler": self._sampler_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.generator.set_state(state["generator"])
        if state["sampler"]:
            self.dataset.sampler.load_state_dict(state["sampler"])

    def _sampler_state(self) -> dict[str, Any]:
        sampler = getattr(self.dataset, "sampler", None)
        state = sampler.state_dict() if sampler is not None and hasattr(sampler, "state_dict") else {}
        return dict(state) if isinstance(state, Mapping) else {}


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
        self._keys: list[NestedKey] | None = None

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
        if self._keys is None:
            entries = sorted(batch.items(True, True), key=lambda item: str(item[0]))
            self._keys = [key for key, value in entries if value.ndim >= 4 and value.dtype == torch.uint8]
        for key in self._keys:
            batch.set(key, self._shift(batch.get(key)))
        for view, pixels in seen.items():
            # Images that the dataset has transformed in its own way are not shifted, nor is a view of them.
            batch.set(view, self._shift(pixels) if self.views[view] in self._keys else pixels.clone())
        return batch

    def _shift(self, pixels: Tensor) -> Tensor:
        images = pixels.reshape(-1, *pixels.shape[-3:])
        offsets = draw_offsets(images.shape[0], SHIFT_PAD, self.generator, images.device)
        return random_shift(images, offsets, pad=SHIFT_PAD).reshape(pixels.shape)


def open_sources(datasets: Any, *, seed: int, device: torch.device) -> list[Source]:
    """Open and name the datasets of a run.

    Args:
        datasets: one dataset or path, a sequence, or a mapping of domain names to them. Each is a directory,
            a :class:`~crptpro.data.FrameDataset`, or anything with ``sample(batch_size)``.
        seed: seeds the sampling of each.
        device: directories are opened on it; a GPU then holds a copy of the frames.

    Raises:
        DatasetError: if there is none, or one has no ``sample``.
    """
    if isinstance(datasets, Mapping):
        named: list[tuple[str | None, Any]] = list(datasets.items())
    elif isinstance(datasets, (str, Path)) or hasattr(datasets, "sample"):
        named = [(None, datasets)]
    else:
        named = [(None, dataset) for dataset in datasets]
    if not named:
        raise DatasetError("pretrain needs at least one dataset, got none.")
    sources: list[Source] = []
    taken: set[str] = set()
    for index, (given, dataset) in enumerate(named):
        if isinstance(dataset, (str, Path)):
            dataset = FrameDataset.open(dataset, device=device)
        if not callable(getattr(dataset, "sample", None)):
            raise DatasetError(f"Dataset {index} is a {type(dataset).__name__} without `sample(batch_size)`.")
        base = given or getattr(dataset, "domain", None) or f"domain_{index}"
        base = str(base).replace(",", "_")
        name = base
        for copy in range(2, len(named) + 2):
            if name not in taken:
                break
            name = f"{base}_{copy}"
        taken.add(name)
        sources.append(Source(name, dataset, seed=seed))
    return sources


def keys_read(loss: LossModule) -> list[NestedKey] | None:
    """Return the entries a loss reads, or ``None`` if it does not say."""
    try:
        keys = loss.in_keys
    except (AttributeError, NotImplementedError):
        return None
    return list(keys) if keys else None


def views_read(loss: LossModule) -> dict[NestedKey, NestedKey]:
    """Return which entries a loss reads as a second view of another one; none if it does not say."""
    return dict(getattr(loss, "views", None) or {})


def _length(dataset: Any) -> int | None:
    return len(dataset) if hasattr(dataset, "__len__") else None

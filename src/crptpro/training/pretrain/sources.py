"""The datasets of a pre-training run: named and seeded one by one."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS

from crptpro.data import FrameDataset
from crptpro.errors import DatasetError
from crptpro.seeding import derive_seed
from crptpro.transforms.random_shift import draw_offsets, shifted_stacks

_LOG = logging.getLogger(__name__)

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
        if getattr(dataset, "_prefetch", False):
            _LOG.warning(
                "The dataset %r prefetches: what it drew ahead is lost when a run stops, so that a resumed run differs "
                "from one that was not stopped. Open it without prefetch for the same numbers.",
                name,
            )

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
        # Which rows count comes along where the dataset says it.
        masks = [key for key in AUTO_LOSS_MASK_KEYS if key in held]
        return batch.select(*keys, *masks)

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
    mask = getattr(loss, "loss_mask_key", None)  # "auto" looks for usual names, which no dataset need have
    named = [] if mask in (None, "auto") else [mask]
    return [*keys, *named] if keys else None


def views_read(loss: LossModule) -> dict[NestedKey, NestedKey]:
    """Return which entries a loss reads as a second view of another one; none if it does not say."""
    return dict(getattr(loss, "views", None) or {})


def _length(dataset: Any) -> int | None:
    return len(dataset) if hasattr(dataset, "__len__") else None

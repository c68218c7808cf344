"""Which domains an update learns from: one after the other, one at random, or all at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase

from crptpro.errors import DatasetError
from crptpro.seeding import derive_seed
from crptpro.training.pretrain.augmenter import Augmenter
from crptpro.training.pretrain.device_batches import DeviceBatches
from crptpro.training.pretrain.sources import Source

DomainSchedule = Literal["cycle", "random", "mixed"]

ALL = "all"
"""What stands for the domain where a batch has rows of every one."""

_WORDS = {
    "cycle": "one domain after the other",
    "random": "a random domain each",
    "mixed": "all domains in each",
}


class Turns:
    """Makes the batch of every update, by a schedule of the domains.

    Args:
        schedule: ``"cycle"``: update u (from 0) takes dataset u mod N; ``"random"``: one drawn uniformly;
            ``"mixed"``: rows of every dataset, see :func:`shares`.
        sources: the datasets in cyclic order.
        augmenter: applied to the rows of each dataset.
        batches: draws the batches where a GPU holds the frames; the augmenter draws them otherwise. Not for
            ``"mixed"``.
        keys: entries that the loss reads; all of the dataset if ``None``.
        batch_size: rows per update.
        seed: decides the draws of ``"random"``.
        device: where the batches are returned.

    Raises:
        ValueError: see :func:`require_schedule`.
    """

    def __init__(
        self,
        schedule: DomainSchedule,
        sources: Sequence[Source],
        augmenter: Augmenter,
        *,
        batches: DeviceBatches | None = None,
        keys: Sequence[NestedKey] | None,
        batch_size: int,
        seed: int,
        device: torch.device,
    ) -> None:
        require_schedule(schedule, batch_size=batch_size, num_domains=len(sources))
        self.schedule, self.sources, self.augmenter, self.batches = schedule, sources, augmenter, batches
        self.keys, self.batch_size, self.seed, self.device = keys, batch_size, seed, device
        self.domains = [source.name for source in sources]

    @property
    def names(self) -> list[str]:
        """What a turn can be: the domains, or all of them at once."""
        return [ALL] if self.schedule == "mixed" else self.domains

    @property
    def words(self) -> str:
        """The schedule, for people."""
        return _WORDS[self.schedule]

    @property
    def probed_updates(self) -> int:
        """How many updates before a row of the record hold every domain, as good as surely for ``"random"``."""
        return {"cycle": 1, "random": 4, "mixed": 1}[self.schedule] * len(self.names)

    def turn(self, update: int) -> int:
        """Return which of ``names`` an update (from 0) learns from; nothing but the seed decides it."""
        if self.schedule == "random":
            # The number of the update is all the state there is, so that a resumed run goes on the same way.
            return derive_seed(self.seed, "pretrain", "domain", update) % len(self.names)
        return update % len(self.names)

    def batch(self, turn: int) -> TensorDictBase:
        """Draw the next augmented batch ``[batch_size]`` of a turn.

        Raises:
            DatasetError: if a dataset lacks an entry that the loss reads, or a mixed batch cannot be put together.
        """
        if self.schedule == "mixed":
            return self._mixed()
        source = self.sources[turn]
        if self.batches is not None:
            return self.batches.sample(source.name)
        return self.augmenter.sample(source, self.batch_size, self.keys, self.device)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of datasets and generators."""
        return {
            "sources": {source.name: source.state_dict() for source in self.sources},
            "augment": self.augmenter.generator.get_state(),
            "batches": None if self.batches is None else self.batches.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`; further entries are left alone."""
        for source in self.sources:
            source.load_state_dict(state["sources"][source.name])
        self.augmenter.generator.set_state(state["augment"])
        if self.batches is not None:
            self.batches.load_state_dict(state["batches"])

    def _mixed(self) -> TensorDictBase:
        rows = shares(self.batch_size, len(self.sources))
        parts = [
            self.augmenter.sample(source, count, self.keys, self.device)
            for source, count in zip(self.sources, rows)
        ]
        forms = [_form(part) for part in parts]
        for domain, form in zip(self.domains, forms):
            differing = sorted({key for key, _ in form.items() ^ forms[0].items()})
            if differing:
                raise DatasetError(
                    f"The entries {', '.join(differing)} of {self.domains[0]!r} and {domain!r} differ in shape or "
                    "type, or one lacks them: no batch can have rows of both. Take domain_schedule 'cycle', or a "
                    "loss whose `in_keys` name only entries that are alike."
                )
        return torch.cat(parts)


def require_schedule(schedule: str, *, batch_size: int, num_domains: int) -> None:
    """Refuse an unknown schedule, and mixed batches of fewer rows than domains.

    Raises:
        ValueError: naming the value, or both numbers.
    """
    if schedule not in get_args(DomainSchedule):
        raise ValueError(f"`domain_schedule` must be 'cycle', 'random' or 'mixed', got {schedule!r}.")
    if schedule == "mixed" and batch_size < num_domains:
        raise ValueError(
            "`batch_size` must be at least the number of domains for domain_schedule 'mixed', got "
            f"{batch_size} and {num_domains}."
        )


def shares(batch_size: int, num_domains: int) -> list[int]:
    """Split a batch over the domains as evenly as possible; the first ones get the remainder.

    Examples:
        >>> shares(512, 3)
        [171, 171, 170]
    """
    least, more = divmod(batch_size, num_domains)
    return [least + (domain < more) for domain in range(num_domains)]


def _form(batch: TensorDictBase) -> dict[str, tuple[torch.dtype, torch.Size]]:
    """Type and shape of a row of each entry, by the entry's name."""
    return {str(key): (value.dtype, value.shape[1:]) for key, value in batch.items(True, True)}

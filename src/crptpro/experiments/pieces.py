"""What an experiment is made of: datasets, encoders, runs and measurements, each named by all that determines it.

A piece is a frozen description. Its :attr:`~Piece.key` is the name of its directory below ``ROOT/pieces``, a readable
part and a hash of the description with everything it needs, so that experiments share what they have in common and a
changed number makes a new piece. Fields at their default are not hashed: a field that is added later with the default
"as before" renames nothing.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from crptpro.colors import Colors
from crptpro.errors import RecordError
from crptpro.quality import Quality

Settings = tuple[tuple[str, Any], ...]
"""Settings that differ from a stage's defaults, sorted by name, values of JSON's kinds with tuples for lists."""

KINDS: dict[str, type[Piece]] = {}
"""Kind of a piece, as in its description, to its class."""


def settings(**values: Any) -> Settings:
    """Return keyword arguments as they are kept in a piece.

    Examples:
        >>> settings(learning_rate=1e-3, batch_size=128)
        (('batch_size', 128), ('learning_rate', 0.001))
    """
    return tuple(sorted(values.items()))


class Piece(ABC):
    """Base of every piece; subclasses are frozen dataclasses."""

    kind: ClassVar[str] = ""
    is_exclusive: ClassVar[bool] = False
    """Must be made alone on its machine: it measures time."""
    reads_replays: ClassVar[bool] = False
    """Reads what explorers saw, and not only the encoders that they trained."""
    leftovers: ClassVar[tuple[str, ...]] = ()
    """Directories that only an unfinished piece needs; they are removed when it is finished."""

    def __init_subclass__(cls) -> None:
        """Make the kind known to :func:`piece_from_json`."""
        if cls.kind:
            KINDS[cls.kind] = cls

    @property
    @abstractmethod
    def title(self) -> str:
        """A few words for a person, without the numbers that the key hashes."""

    @property
    def needs(self) -> tuple[Piece, ...]:
        """What has to be finished before this piece can be made, direct needs only."""
        found: list[Piece] = []
        for entry in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, entry.name)
            found += [
                part for part in (value if isinstance(value, tuple) else (value,)) if isinstance(part, Piece)
            ]
        return tuple(found)

    @cached_property
    def key(self) -> str:
        """Name of the piece's directory."""
        text = json.dumps(self.to_json(), sort_keys=True, separators=(",", ":"))
        name = re.sub(r"[^a-zA-Z0-9._]+", "-", self.title).strip("-")
        return f"{self.kind}-{name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"

    def to_json(self) -> dict[str, Any]:
        """Return the description, with the pieces that it needs inside."""
        content: dict[str, Any] = {"kind": self.kind}
        for entry in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, entry.name)
            if entry.default is dataclasses.MISSING or value != entry.default:
                content[entry.name] = _plain(value)
        return content


def piece_from_json(content: dict[str, Any]) -> Piece:
    """Read a description back.

    Raises:
        RecordError: if it is none, or one of a newer revision.
    """
    if content.get("kind") not in KINDS:
        raise RecordError(
            f"There is no kind of piece {content.get('kind')!r}; known are {', '.join(sorted(KINDS))}."
        )
    values = {name: _piece_or_value(value) for name, value in content.items() if name != "kind"}
    try:
        return KINDS[content["kind"]](**values)
    except TypeError as reason:
        raise RecordError(f"This is no description of a piece of kind {content['kind']}: {reason}.") from None


def _plain(value: Any) -> Any:
    if isinstance(value, Piece):
        return value.to_json()
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def _piece_or_value(value: Any) -> Any:
    if isinstance(value, dict):
        return piece_from_json(value)
    return tuple(_piece_or_value(part) for part in value) if isinstance(value, list) else value


@dataclass(frozen=True)
class DatasetPiece(Piece):
    """Random transitions of a domain, in ``<piece>/<domain>``; ``definition`` as for :class:`RunPiece`."""

    kind = "dataset"
    domain: str
    transitions: int
    seed: int
    quality: Quality = "exact"
    colors: Colors = "normal"
    definition: str = ""

    @property
    def title(self) -> str:
        """Domain, colours and seed."""
        colors = "" if self.colors == "normal" else f" {self.colors}"
        return f"{self.domain}{colors} seed {self.seed}"


@dataclass(frozen=True)
class EncoderPiece(Piece):
    """An encoder, in ``<piece>/encoder``; made in one of the ways below.

    Args:
        method: registered name of the method that trains it.
        seed: of everything in its training, the first of the two seed levels.
    """

    leftovers = ("checkpoints",)
    method: str
    seed: int

    @property
    def domain_names(self) -> tuple[str, ...]:
        """Domains that it was trained on last."""
        return ()

    @property
    def lineage(self) -> tuple[EncoderPiece, ...]:
        """The encoder, then those that it started from, the first of all last."""
        return (self,)


@dataclass(frozen=True)
class UntrainedPiece(EncoderPiece):
    """An encoder at its initialisation, the control."""

    kind = "untrained"

    @property
    def title(self) -> str:
        """The seed."""
        return f"seed {self.seed}"


@dataclass(frozen=True)
class PretrainedPiece(EncoderPiece):
    """An encoder trained on datasets.

    Args:
        datasets: one per domain.
        updates: of the encoder, over all domains.
        training: further arguments of :func:`crptpro.training.pretrain`.
        loss: options of the method's loss.
        encoder: options of :class:`crptpro.modules.PixelEncoder`, besides the method's.
        snapshots: updates after which the encoder is kept too, in ``<piece>/encoder_at_<updates>``.
        definition: what a user's own method was registered with, as JSON; empty for those of the library.
    """

    kind = "encoder"
    datasets: tuple[DatasetPiece, ...]
    updates: int
    training: Settings = ()
    loss: Settings = ()
    encoder: Settings = ()
    snapshots: tuple[int, ...] = ()
    definition: str = ""

    @property
    def domain_names(self) -> tuple[str, ...]:
        """Domains of the datasets."""
        return tuple(dataset.domain for dataset in self.datasets)

    @property
    def title(self) -> str:
        """Method, domains and seed."""
        return f"{self.method} {'+'.join(self.domain_names)} seed {self.seed}"


@dataclass(frozen=True)
class ExploredPiece(EncoderPiece):
    """An encoder trained on what its own agents saw; their replays stay in ``<piece>/replay``.

    Args:
        domains: which take turns.
        explore: settings of :class:`crptpro.training.ActiveConfig`.
        loss: options of the method's loss.
        definition: what a user's own method was registered with, as JSON; empty for those of the library.
        domain_definitions: the same of each domain; empty if none is the user's own.
    """

    kind = "explored"
    domains: tuple[str, ...]
    explore: Settings = ()
    loss: Settings = ()
    definition: str = ""
    domain_definitions: tuple[str, ...] = ()

    @property
    def domain_names(self) -> tuple[str, ...]:
        """Domains that were explored."""
        return self.domains

    @property
    def title(self) -> str:
        """Method, domains and seed."""
        return f"{self.method} {'+'.join(self.domains)} seed {self.seed}"


@dataclass(frozen=True)
class FinetunedPiece(EncoderPiece):
    """An encoder trained on, on one domain.

    Args:
        base: the encoder it starts from.
        dataset: of the one domain.
        updates: of the encoder.
        training: further arguments of :func:`crptpro.pretrained.finetune`.
    """

    kind = "finetuned"
    base: EncoderPiece
    dataset: DatasetPiece
    updates: int
    training: Settings = ()

    @property
    def domain_names(self) -> tuple[str, ...]:
        """The one domain."""
        return (self.dataset.domain,)

    @property
    def lineage(self) -> tuple[EncoderPiece, ...]:
        """The encoder, then those that it started from, the first of all last."""
        return (self, *self.base.lineage)

    @property
    def title(self) -> str:
        """Method, domain and seed."""
        return f"{self.method} on {self.dataset.domain} seed {self.seed}"


@dataclass(frozen=True)
class RunPiece(Piece):
    """Reinforcement learning of one task; the piece's directory is the run directory.

    Args:
        task: what is learned.
        encoder: the frozen encoder; ``None`` for DrQ, which trains its own.
        seed: of this stage, the second of the two seed levels.
        colors: of the task's world.
        config: settings of :class:`crptpro.training.DownstreamConfig` that differ from the algorithm's.
        definition: what a user's own domain was registered with, as JSON; empty for others.
    """

    kind = "run"
    leftovers = ("checkpoints", "replay")
    task: str
    encoder: EncoderPiece | None
    seed: int
    colors: Colors = "normal"
    config: Settings = ()
    definition: str = ""

    @property
    def title(self) -> str:
        """Task, encoder's method, colours and seed."""
        encoder = "drq" if self.encoder is None else f"{self.encoder.method} encoder {self.encoder.seed}"
        colors = "" if self.colors == "normal" else f" {self.colors}"
        return f"{self.task}{colors} {encoder} seed {self.seed}"

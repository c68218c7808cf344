"""Pieces that measure what others have made: states told by features, costs, prototypes, coverage, components."""

from __future__ import annotations

from dataclasses import dataclass, replace

from crptpro.colors import Colors, is_drawn
from crptpro.experiments.pieces import DatasetPiece, EncoderPiece, ExploredPiece, Piece


@dataclass(frozen=True)
class TimingPiece(Piece):
    """What training encoders costs, measured on a short part of it, as ``timing.csv``.

    The device and the threads are a part of what is measured, other than in pieces that come out the same on any.

    Args:
        encoders: one, or, of a method that has an encoder per domain, several whose costs add up. They need not be
            made.
        paper: the same, trained as the paper trains them: with its batches, budgets and intervals.
        updates: encoder updates that are timed at least, after as many to warm up.
        paper_timed: the same of ``paper``'s, on the data of ``encoders``; 0 leaves the hours of the paper's budget
            open, unless both are trained alike.
        device: of networks.
        threads: of torch.
    """

    kind = "timing"
    is_exclusive = True
    encoders: tuple[EncoderPiece, ...]
    paper: tuple[EncoderPiece, ...]
    updates: int
    paper_timed: int = 0
    device: str = "cpu"
    threads: int = 1

    @property
    def title(self) -> str:
        """Method, domains and device."""
        domains = "+".join(d for e in self.encoders for d in e.domain_names)
        return f"{self.encoders[0].method} {domains} {self.device} {self.threads}"

    @property
    def needs(self) -> tuple[Piece, ...]:
        """The data of a single encoder; of several, the timing of each."""
        return self.parts if len(self.encoders) > 1 else self.encoders[0].needs

    @property
    def parts(self) -> tuple[TimingPiece, ...]:
        """The same for each encoder alone."""
        return tuple(
            replace(self, encoders=(encoder,), paper=(whole,))
            for encoder, whole in zip(self.encoders, self.paper, strict=True)
        )


@dataclass(frozen=True)
class RedrawnPiece(Piece):
    """What probes of a dataset read, drawn in other colours once for all encoders, in ``<piece>/frames``.

    Args:
        dataset: with the states.
        colors: in which they are drawn.
        samples: of the probes.
        seed: of their draw.
        frame_stack: frames per observation.
    """

    kind = "redrawn"
    dataset: DatasetPiece
    colors: Colors
    samples: int
    seed: int
    frame_stack: int = 3

    @property
    def title(self) -> str:
        """Domain and colours."""
        return f"{self.dataset.domain} {self.colors} seed {self.dataset.seed}"


@dataclass(frozen=True)
class ProbePiece(Piece):
    """The state probe of one encoder on one domain, as ``probe.csv``.

    Args:
        encoder: whose features are read.
        dataset: with the states; held-out episodes are a part of it.
        colors: in which the same states are drawn.
        samples: drawn from the dataset.
        seed: of the draw.
        at_updates: which of the encoder's snapshots is read; ``None`` for the finished encoder.
    """

    kind = "probe"
    encoder: EncoderPiece
    dataset: DatasetPiece
    colors: Colors = "normal"
    samples: int = 2_000
    seed: int = 0
    at_updates: int | None = None

    @property
    def title(self) -> str:
        """Encoder's method, when, domain and colours."""
        colors = "" if self.colors == "normal" else f" {self.colors}"
        when = "" if self.at_updates is None else f" at {self.at_updates}"
        return f"{self.encoder.method} seed {self.encoder.seed}{when} on {self.dataset.domain}{colors}"

    @property
    def needs(self) -> tuple[Piece, ...]:
        """Encoder and dataset, and the pictures if other colours have to be drawn."""
        drawn = () if self.redrawn is None else (self.redrawn,)
        return (self.encoder, self.dataset, *drawn)

    @property
    def redrawn(self) -> RedrawnPiece | None:
        """The pictures in other colours; ``None`` where those of the dataset serve."""
        if not is_drawn(self.dataset.colors, self.colors):
            return None
        return RedrawnPiece(self.dataset, self.colors, self.samples, self.seed)


@dataclass(frozen=True)
class PrototypesPiece(Piece):
    """How far the prototypes of an encoder have spread, along its training and at its end, as ``prototypes.csv``.

    Args:
        encoder: of a method that has prototypes.
    """

    kind = "prototypes"
    encoder: EncoderPiece

    @property
    def title(self) -> str:
        """The encoder's method, domains and seed."""
        return f"{self.encoder.method} {'+'.join(self.encoder.domain_names)} seed {self.encoder.seed}"


@dataclass(frozen=True)
class CoveragePiece(Piece):
    """How widely an explorer's observations are spread along its training, beside random data, as ``coverage.csv``.

    A window has the same decisions of both sources: an explorer's first hundred stand beside a dataset's first hundred.
    Where a source does not have enough of them (a smaller dataset, a replay that went round), it has no row.

    Args:
        explorer: whose replays are read.
        datasets: random transitions of the same domains.
        encoder: which embeds both; the same for all that is compared.
        samples: observations per estimate.
        windows: of the training, of equal length; fewer where one would have less than ``samples`` decisions of a
            domain.
        seed: of the draw.
    """

    kind = "coverage"
    reads_replays = True
    explorer: ExploredPiece
    datasets: tuple[DatasetPiece, ...]
    encoder: EncoderPiece
    samples: int = 1_024
    windows: int = 10
    seed: int = 0

    @property
    def title(self) -> str:
        """The explorer's method, domains and seed."""
        return f"{self.explorer.method} {'+'.join(self.explorer.domains)} seed {self.explorer.seed}"


@dataclass(frozen=True)
class EmbeddingsPiece(Piece):
    """Principal components of random data of several domains and of an explorer's, as ``embeddings.csv``.

    Args:
        encoder: which embeds all of them.
        datasets: random transitions.
        explorer: of one domain; the last quarter of what it keeps is drawn from.
        samples: observations of each source.
        seed: of the draw.
    """

    kind = "embeddings"
    reads_replays = True
    encoder: EncoderPiece
    datasets: tuple[DatasetPiece, ...]
    explorer: ExploredPiece
    samples: int = 125
    seed: int = 0

    @property
    def title(self) -> str:
        """The encoder, its domains, and the explorer's domain."""
        domains = "+".join(d.domain for d in self.datasets)
        explored = "+".join(self.explorer.domains)
        return (
            f"{self.encoder.method} {domains} and {self.explorer.method} {explored} seed {self.encoder.seed}"
        )

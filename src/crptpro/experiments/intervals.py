"""A number, or a curve, that cannot be had without its interval and the runs that it stands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from crptpro.experiments.statistics import Array


@dataclass(frozen=True)
class Basis:
    """What an estimate stands on.

    Args:
        tasks: how many.
        runs: of all tasks together; of both methods together where two are compared.
        encoders: different encoders among the runs, ``None`` if they were not told.
        level: what the replicates of its interval redraw first.
        confidence: of the interval, in (0, 1).
        replicates: of the bootstrap.
        seed: of the bootstrap.
        why_no_interval: the reason if there is none; empty if there is one.
    """

    tasks: int
    runs: int
    encoders: int | None
    level: Literal["runs", "encoders"]
    confidence: float
    replicates: int
    seed: int
    why_no_interval: str = ""

    def __str__(self) -> str:
        """Return e.g. ``3 tasks, 36 runs of 3 encoders, 95% interval over encoders``."""
        runs = _count(self.runs, "run")
        if self.encoders is not None:
            runs += f" of {_count(self.encoders, 'encoder')}"
        interval = self.why_no_interval or f"{self.confidence:.0%} interval over {self.level}"
        return f"{_count(self.tasks, 'task')}, {runs}, {interval}"


@dataclass(frozen=True)
class Estimate:
    """A number, its interval, and what it stands on.

    Args:
        value: of all runs, not of the replicates.
        interval: lower and upper end, ``None`` if the runs do not tell (``basis.why_no_interval``).
        basis: what it stands on.
    """

    value: float
    interval: tuple[float, float] | None
    basis: Basis

    def __format__(self, spec: str) -> str:
        """Return value and interval in a number format, e.g. ``f"{estimate:.2f}"`` gives ``0.43 [0.31, 0.52]``."""
        if self.interval is None:
            return f"{self.value:{spec}} [no interval]"
        return f"{self.value:{spec}} [{self.interval[0]:{spec}}, {self.interval[1]:{spec}}]"

    def __str__(self) -> str:
        """Return value, interval and what they stand on."""
        return f"{self:.3g} ({self.basis})"


@dataclass(frozen=True)
class CurveEstimate:
    """A curve, its pointwise intervals, and what it stands on.

    Args:
        x: ``[K]``, thresholds or env steps.
        values: ``[K]``.
        low: lower ends ``[K]``, ``None`` if the runs do not tell (``basis.why_no_interval``).
        high: upper ends ``[K]``, likewise.
        basis: what it stands on.
    """

    x: Array
    values: Array
    low: Array | None
    high: Array | None
    basis: Basis


@dataclass(frozen=True)
class Bootstrap:
    """How intervals are made: percentiles of the aggregate over resampled runs.

    Args:
        confidence: in (0, 1).
        replicates: how many resamples.
        seed: same seed, same interval, whatever the order of tasks.

    Raises:
        ValueError: a value that is not allowed.
    """

    confidence: float = 0.95
    replicates: int = 2_000
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse values that cannot be."""
        if not 0 < self.confidence < 1:
            raise ValueError(f"`confidence` must be between 0 and 1, got {self.confidence}.")
        if self.replicates < 1:
            raise ValueError(f"`replicates` must be at least 1, got {self.replicates}.")
        if self.seed < 0:
            raise ValueError(f"`seed` must be 0 or more, got {self.seed}.")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"

"""Runs of one method as they enter an estimate: checked, and redrawn by one of two levels."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crptpro.experiments.bootstrap import encoder_indices, run_indices
from crptpro.experiments.statistics import Array

Scores = Mapping[Any, ArrayLike]
Encoders = Mapping[Any, Sequence[str]]
Runs = Mapping[Any, Sequence[str]]


@dataclass(frozen=True)
class Sample:
    """The runs of one method, checked, tasks in an order that does not depend on the caller's.

    Args:
        tasks: what runs are compared under.
        scores: ``[R_t]``, or ``[K, R_t]`` of curves, per task.
        encoders: of each run, per task; ``None`` where intervals are over runs.
        runs: what each run is called, per task.
    """

    tasks: list[Hashable]
    scores: list[Array]
    encoders: list[tuple[str, ...]] | None
    runs: list[tuple[str, ...]]

    @classmethod
    def of(
        cls,
        scores: Scores,
        encoders: Encoders | None,
        runs: Runs | None = None,
        points: int | None = None,
    ) -> Sample:
        """Check scores, and what is told of their runs.

        Args:
            scores: task to ``[R_t]``, or to curves ``[R_t, K]``.
            encoders: task to the encoder of each run.
            runs: task to what each run is called; all different if ``None``.
            points: the ``K`` of curves.

        Raises:
            ValueError: no task, a task without runs, a score that is not finite, or labels that do not match.
        """
        if not scores:
            raise ValueError("There are no tasks to estimate from.")
        tasks = sorted(scores, key=str)
        arrays = [_checked(task, scores[task], points) for task in tasks]
        for told, what in ((encoders, "encoders"), (runs, "names")):
            for task, array in zip(tasks, arrays):
                if told is not None and len(told.get(task, ())) != array.shape[-1]:
                    count = len(told.get(task, ()))
                    raise ValueError(f"{task} has {array.shape[-1]} runs, and {what} are told of {count}.")
        if runs is None:
            names = [tuple(f"{at}.{i}" for i in range(a.shape[-1])) for at, a in enumerate(arrays)]
        else:
            names = [tuple(runs[task]) for task in tasks]
        labels = None if encoders is None else [tuple(encoders[task]) for task in tasks]
        return cls(tasks, arrays, labels, names)

    @property
    def count(self) -> int:
        """Number of different runs."""
        return len({name for names in self.runs for name in names})

    def why_no_interval(self) -> str:
        """Say what keeps an interval from being made; empty if nothing does."""
        kind = "run" if self.encoders is None else "encoder"
        draws = [array.shape[-1] for array in self.scores]
        if self.encoders is not None:
            draws = [len(set(labels)) for labels in self.encoders]
        single = [str(task) for task, count in zip(self.tasks, draws) if count < 2]
        return f"no interval: a single {kind} on {', '.join(single)}" if single else ""

    def redrawn(self, replicates: int, rng: np.random.Generator) -> list[Array]:
        """Return one ``[B, R_t]`` or ``[B, K, R_t]`` per task."""
        counts = [array.shape[-1] for array in self.scores]
        if self.encoders is not None:
            indices = encoder_indices(self.encoders, runs=self.runs, replicates=replicates, rng=rng)
        elif self.count < sum(
            counts
        ):  # a run that stands in several rows is what an encoder is to several runs
            indices = encoder_indices(self.runs, runs=self.runs, replicates=replicates, rng=rng)
        else:
            indices = run_indices(counts, replicates=replicates, rng=rng)
        return [np.moveaxis(array[..., index], -2, 0) for array, index in zip(self.scores, indices)]


def _checked(task: Hashable, scores: ArrayLike, points: int | None) -> Array:
    array = np.asarray(scores, dtype=np.float64)
    wanted = 1 if points is None else 2
    if array.ndim != wanted or not len(array) or (points is not None and array.shape[1] != points):
        shape = "[runs]" if points is None else f"[runs, {points}]"
        raise ValueError(
            f"The scores of {task} must be {shape} with one run at least, got shape {array.shape}."
        )
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        raise ValueError(
            f"Run {int(wrong[0][0])} of {task} has the score {array[tuple(wrong[0])]}. A run that diverged has no "
            "score: leave it out and say so."
        )
    return array.T if points is not None else array

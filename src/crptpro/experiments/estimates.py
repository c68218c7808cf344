"""Estimates from many runs, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crptpro.experiments.bootstrap import encoder_indices, run_indices
from crptpro.experiments.intervals import Basis, Bootstrap, CurveEstimate, Estimate
from crptpro.experiments.statistics import (
    Aggregate,
    Array,
    iqm,
    performance_profile,
    probability_of_improvement,
)

Scores = Mapping[Any, ArrayLike]
Encoders = Mapping[Any, Sequence[str]]


def estimate(
    scores: Scores,
    aggregate: Aggregate = iqm,
    *,
    encoders: Encoders | None = None,
    bootstrap: Bootstrap | None = None,
) -> Estimate:
    """Aggregate runs of several tasks to one number with an interval.

    Args:
        scores: task to one score per run ``[R_t]``.
        aggregate: of :mod:`crptpro.experiments.statistics`, e.g. ``mean``, ``median``, ``optimality_gap``.
        encoders: task to the encoder of each run. If given, the interval redraws encoders first;
            :mod:`crptpro.experiments.bootstrap` says when that is right.
        bootstrap: how the interval is made.

    Returns:
        The estimate. Its interval is ``None`` where a task has a single run, or, with ``encoders``, runs of a single
        encoder: one draw says nothing about the next, and a width of zero would be a lie.

    Raises:
        ValueError: no task, a task without runs, a score that is not finite (named), or encoders that do not match.

    Examples:
        >>> from crptpro.experiments.statistics import mean
        >>> print(f"{estimate({'walker_run': [500.0, 520.0, 540.0]}, mean):.0f}")
        520 [500, 540]
        >>> print(estimate({"walker_run": [512.0]}, mean))
        512 [no interval] (1 task, 1 run, no interval: a single run on walker_run)
    """
    how = bootstrap or Bootstrap()
    sample = _Sample.of(scores, encoders)
    value, ends = _interval([sample], lambda parts: aggregate(parts[0]), how)
    return _scalar(value, ends, _basis([sample], how))


def estimate_improvement(
    scores: Scores,
    others: Scores,
    *,
    encoders: Encoders | None = None,
    other_encoders: Encoders | None = None,
    bootstrap: Bootstrap | None = None,
) -> Estimate:
    """Estimate how probably a run of one method beats one of another on the same task.

    Both methods are redrawn independently of each other. The value is that of
    :func:`~crptpro.experiments.statistics.probability_of_improvement`.

    Args:
        scores: task to one score per run, the method that may be better.
        others: the same for the other; numbers of runs may differ.
        encoders: as of :func:`estimate`, for ``scores``.
        other_encoders: the same for ``others``.
        bootstrap: how the interval is made.

    Returns:
        The estimate, in [0, 1]; half means no difference.

    Raises:
        ValueError: as of :func:`estimate`, tasks that only one method has (named), or encoders of one only.
    """
    if set(scores) != set(others):
        odd = ", ".join(sorted(str(task) for task in set(scores) ^ set(others)))
        raise ValueError(f"Only one of the methods has runs on {odd}; compare them on the tasks they share.")
    if (encoders is None) != (other_encoders is None):
        raise ValueError(
            "Tell the encoders of both methods or of none: one interval cannot mix the two levels."
        )
    how = bootstrap or Bootstrap()
    samples = [_Sample.of(scores, encoders), _Sample.of(others, other_encoders)]
    value, ends = _interval(samples, lambda parts: probability_of_improvement(parts[0], parts[1]), how)
    return _scalar(value, ends, _basis(samples, how))


def estimate_profile(
    scores: Scores,
    thresholds: ArrayLike,
    *,
    encoders: Encoders | None = None,
    bootstrap: Bootstrap | None = None,
) -> CurveEstimate:
    """Estimate which fraction of runs scores above each threshold, with pointwise intervals.

    Args:
        scores: task to one score per run ``[R_t]``, normalised so that a threshold means the same on all.
        thresholds: ``[K]``.
        encoders: as of :func:`estimate`.
        bootstrap: how the intervals are made.

    Raises:
        ValueError: as of :func:`estimate`.
    """
    how = bootstrap or Bootstrap()
    sample = _Sample.of(scores, encoders)
    value, ends = _interval([sample], lambda parts: performance_profile(parts[0], thresholds), how)
    return _curve(thresholds, value, ends, _basis([sample], how))


def estimate_curve(
    env_steps: ArrayLike,
    scores: Scores,
    aggregate: Aggregate = iqm,
    *,
    encoders: Encoders | None = None,
    bootstrap: Bootstrap | None = None,
) -> CurveEstimate:
    """Aggregate learning curves, with pointwise intervals: a run is redrawn with its whole curve.

    Args:
        env_steps: ``[K]``, where all runs were evaluated.
        scores: task to one score per run and place ``[R_t, K]``.
        aggregate: as of :func:`estimate`.
        encoders: as of :func:`estimate`.
        bootstrap: how the intervals are made.

    Raises:
        ValueError: as of :func:`estimate`, or a curve of another length.
    """
    how = bootstrap or Bootstrap()
    sample = _Sample.of(scores, encoders, points=len(np.asarray(env_steps)))
    value, ends = _interval([sample], lambda parts: aggregate(parts[0]), how)
    return _curve(env_steps, value, ends, _basis([sample], how))


@dataclass(frozen=True)
class _Sample:
    """The runs of one method, checked, tasks in an order that does not depend on the caller's."""

    tasks: list[Hashable]
    scores: list[Array]  # (R_t,) or (K, R_t)
    encoders: list[tuple[str, ...]] | None

    @classmethod
    def of(cls, scores: Scores, encoders: Encoders | None, points: int | None = None) -> _Sample:
        if not scores:
            raise ValueError("There are no tasks to estimate from.")
        tasks = sorted(scores, key=str)
        arrays = [_checked(task, scores[task], points) for task in tasks]
        if encoders is None:
            return cls(tasks, arrays, None)
        for task, array in zip(tasks, arrays):
            told = len(encoders.get(task, ()))
            if told != array.shape[-1]:
                raise ValueError(f"{task} has {array.shape[-1]} runs, and encoders are told of {told}.")
        return cls(tasks, arrays, [tuple(encoders[task]) for task in tasks])

    def why_no_interval(self) -> str:
        kind = "run" if self.encoders is None else "encoder"
        draws = [array.shape[-1] for array in self.scores]
        if self.encoders is not None:
            draws = [len(set(labels)) for labels in self.encoders]
        single = [str(task) for task, count in zip(self.tasks, draws) if count < 2]
        return f"no interval: a single {kind} on {', '.join(single)}" if single else ""

    def redrawn(self, replicates: int, rng: np.random.Generator) -> list[Array]:
        """Return one ``[B, R_t]`` or ``[B, K, R_t]`` per task."""
        if self.encoders is None:
            counts = [array.shape[-1] for array in self.scores]
            indices = run_indices(counts, replicates=replicates, rng=rng)
        else:
            indices = encoder_indices(self.encoders, replicates=replicates, rng=rng)
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


def _interval(
    samples: list[_Sample], aggregate: Callable[[list[list[Array]]], Array], how: Bootstrap
) -> tuple[Array, Array | None]:
    """Return the aggregate of the runs, and the ends of its interval ``[2, ...]`` if there is one."""
    value = aggregate([sample.scores for sample in samples])
    if any(sample.why_no_interval() for sample in samples):
        return value, None
    rng = np.random.default_rng(how.seed)
    replicates = aggregate([sample.redrawn(how.replicates, rng) for sample in samples])
    tail = 50 * (1 - how.confidence)
    return value, np.percentile(replicates, [tail, 100 - tail], axis=0)


def _basis(samples: list[_Sample], how: Bootstrap) -> Basis:
    labels = [label for s in samples if s.encoders is not None for task in s.encoders for label in task]
    is_told = samples[0].encoders is not None
    return Basis(
        tasks=len(samples[0].tasks),
        runs=sum(array.shape[-1] for sample in samples for array in sample.scores),
        encoders=len(set(labels)) if is_told else None,
        level="encoders" if is_told else "runs",
        confidence=how.confidence,
        replicates=how.replicates,
        seed=how.seed,
        why_no_interval=next((why for s in samples if (why := s.why_no_interval())), ""),
    )


def _scalar(value: Array, ends: Array | None, basis: Basis) -> Estimate:
    return Estimate(float(value), None if ends is None else (float(ends[0]), float(ends[1])), basis)


def _curve(x: ArrayLike, values: Array, ends: Array | None, basis: Basis) -> CurveEstimate:
    low, high = (None, None) if ends is None else (ends[0], ends[1])
    return CurveEstimate(np.asarray(x, dtype=np.float64), values, low, high, basis)

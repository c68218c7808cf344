"""Estimates from many runs, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from crptpro.experiments.intervals import Basis, Bootstrap, CurveEstimate, Estimate
from crptpro.experiments.samples import Encoders, Runs, Sample, Scores
from crptpro.experiments.statistics import (
    Aggregate,
    Array,
    iqm,
    performance_profile,
    probability_of_improvement,
)


def estimate(
    scores: Scores,
    aggregate: Aggregate = iqm,
    *,
    encoders: Encoders | None = None,
    runs: Runs | None = None,
    bootstrap: Bootstrap | None = None,
) -> Estimate:
    """Aggregate runs of several tasks to one number with an interval.

    Args:
        scores: task to one score per run ``[R_t]``.
        aggregate: of :mod:`crptpro.experiments.statistics`, e.g. ``mean``, ``median``, ``optimality_gap``.
        encoders: task to the encoder of each run. If given, the interval redraws encoders first;
            :mod:`crptpro.experiments.bootstrap` says when that is right.
        runs: task to what each run is called; one that stands under several tasks counts once, and is redrawn with all
            its places. All are different if ``None``.
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
    sample = Sample.of(scores, encoders, runs)
    value, ends = _interval([sample], lambda parts: aggregate(parts[0]), how)
    return _scalar(value, ends, _basis([sample], how))


def estimate_relative(
    scores: Scores,
    references: Scores,
    *,
    encoders: Encoders | None = None,
    runs: Runs | None = None,
    reference_runs: Runs | None = None,
    bootstrap: Bootstrap | None = None,
) -> Estimate:
    """Estimate the mean over tasks of the ratio of two methods' mean scores.

    The reference was measured too: its runs are redrawn with the others, so that what is not known of it widens the
    interval.

    Args:
        scores: task to one score per run.
        references: the same for the reference; numbers of runs may differ. Its own runs are redrawn, whatever
            ``encoders`` are: DrQ's share none.
        encoders: as of :func:`estimate`, for ``scores``.
        runs: as of :func:`estimate`, for ``scores``.
        reference_runs: the same for ``references``.
        bootstrap: how the interval is made.

    Returns:
        The estimate.

    Raises:
        ValueError: as of :func:`estimate`, tasks that only one method has (named), or a run of the reference with a
            score of 0 or less: no ratio.

    Examples:
        >>> print(f"{estimate_relative({'walker_run': [50.0, 70.0]}, {'walker_run': [100.0, 140.0]}):.2f}")
        0.50 [0.36, 0.70]
    """
    _require_same_tasks(scores, references)
    wrong = [str(task) for task, values in references.items() if np.min(np.asarray(values)) <= 0]
    if wrong:
        raise ValueError(f"A run of the reference scored 0 or less on {', '.join(sorted(wrong))}: no ratio.")
    how = bootstrap or Bootstrap()
    samples = [Sample.of(scores, encoders, runs), Sample.of(references, None, reference_runs)]

    def ratio(parts: list[list[Array]]) -> Array:
        each = [own.mean(axis=-1) / other.mean(axis=-1) for own, other in zip(*parts)]
        return np.mean(np.stack(each), axis=0)

    value, ends = _interval(samples, ratio, how)
    return _scalar(value, ends, _basis(samples, how))


def estimate_improvement(
    scores: Scores,
    others: Scores,
    *,
    encoders: Encoders | None = None,
    other_encoders: Encoders | None = None,
    runs: Runs | None = None,
    other_runs: Runs | None = None,
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
        runs: as of :func:`estimate`, for ``scores``.
        other_runs: the same for ``others``.
        bootstrap: how the interval is made.

    Returns:
        The estimate, in [0, 1]; half means no difference.

    Raises:
        ValueError: as of :func:`estimate`, tasks that only one method has (named), or encoders of one only.
    """
    _require_same_tasks(scores, others)
    if (encoders is None) != (other_encoders is None):
        raise ValueError(
            "Tell the encoders of both methods or of none: one interval cannot mix the two levels."
        )
    how = bootstrap or Bootstrap()
    samples = [Sample.of(scores, encoders, runs), Sample.of(others, other_encoders, other_runs)]
    value, ends = _interval(samples, lambda parts: probability_of_improvement(parts[0], parts[1]), how)
    return _scalar(value, ends, _basis(samples, how))


def estimate_profile(
    scores: Scores,
    thresholds: ArrayLike,
    *,
    encoders: Encoders | None = None,
    runs: Runs | None = None,
    bootstrap: Bootstrap | None = None,
) -> CurveEstimate:
    """Estimate which fraction of runs scores above each threshold, with pointwise intervals.

    Args:
        scores: task to one score per run ``[R_t]``, normalised so that a threshold means the same on all.
        thresholds: ``[K]``.
        encoders: as of :func:`estimate`.
        runs: as of :func:`estimate`.
        bootstrap: how the intervals are made.

    Raises:
        ValueError: as of :func:`estimate`.
    """
    how = bootstrap or Bootstrap()
    sample = Sample.of(scores, encoders, runs)
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
    sample = Sample.of(scores, encoders, None, points=len(np.asarray(env_steps)))
    value, ends = _interval([sample], lambda parts: aggregate(parts[0]), how)
    return _curve(env_steps, value, ends, _basis([sample], how))


def _require_same_tasks(scores: Scores, others: Scores) -> None:
    if set(scores) != set(others):
        odd = ", ".join(sorted(str(task) for task in set(scores) ^ set(others)))
        raise ValueError(f"Only one of the methods has runs on {odd}; compare them on the tasks they share.")


def _interval(
    samples: list[Sample], aggregate: Callable[[list[list[Array]]], Array], how: Bootstrap
) -> tuple[Array, Array | None]:
    """Return the aggregate of the runs, and the ends of its interval ``[2, ...]`` if there is one."""
    value = aggregate([sample.scores for sample in samples])
    if any(sample.why_no_interval() for sample in samples):
        return value, None
    rng = np.random.default_rng(how.seed)
    replicates = aggregate([sample.redrawn(how.replicates, rng) for sample in samples])
    tail = 50 * (1 - how.confidence)
    return value, np.percentile(replicates, [tail, 100 - tail], axis=0)


def _basis(samples: list[Sample], how: Bootstrap) -> Basis:
    labels = [label for s in samples if s.encoders is not None for task in s.encoders for label in task]
    is_told = samples[0].encoders is not None
    return Basis(
        tasks=len(samples[0].tasks),
        runs=sum(sample.count for sample in samples),
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

"""Aggregates of runs over tasks, and bootstrap intervals that account for shared encoders.

Aggregates take one array ``[..., R]`` per task, with its runs along the last axis, and reduce runs and tasks. Source:
Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, 2021, arXiv 2108.13264. They agree
with google-research/rliable where every task has the same number of runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.stats import mannwhitneyu, trim_mean

Array = NDArray[np.float64]

MIN_RUNS = 5
"""A task with fewer runs has no interval: percentile intervals of fewer draws are far too narrow."""
COVERAGE = {5: 0.84, 6: 0.86, 8: 0.89, 10: 0.90}
"""Number of independent normal draws to the coverage of a 95 % percentile interval of their mean."""
CONFIDENCE, REPLICATES, SEED = 0.95, 2_000, 0  # of every interval; the order of the runs does not matter


def mean(scores: Sequence[Array]) -> Array:
    """Return the mean over tasks of the mean over a task's runs."""
    return np.mean([task.mean(axis=-1) for task in scores], axis=0)


def median(scores: Sequence[Array]) -> Array:
    """Return the median over tasks of the mean over a task's runs; with one task, that mean."""
    return np.median([task.mean(axis=-1) for task in scores], axis=0)


def iqm(scores: Sequence[Array]) -> Array:
    """Return the interquartile mean: that of the middle half of all runs of all tasks, sorted together."""
    return np.asarray(trim_mean(np.concatenate(scores, axis=-1), 0.25, axis=-1))


def optimality_gap(scores: Sequence[Array]) -> Array:
    """Return the mean shortfall of normalised runs from 1; a run above 1 counts as 1."""
    return mean([np.maximum(1.0 - task, 0.0) for task in scores])


def probability_of_improvement(scores: Sequence[Array], others: Sequence[Array]) -> Array:
    """Return ``P(X > Y) + P(X = Y) / 2`` over all pairs of runs of two methods on the same task, mean over tasks."""
    # The p-value is not used; it divides by zero if all runs are equal.
    with np.errstate(all="ignore"):
        wins = [
            mannwhitneyu(x, y, axis=-1, method="asymptotic").statistic / (x.shape[-1] * y.shape[-1])
            for x, y in zip(scores, others, strict=True)
        ]
    return np.mean(wins, axis=0)


def relative_mean(scores: Sequence[Array], others: Sequence[Array]) -> Array:
    """Return the mean over tasks of the ratio of two methods' mean scores."""
    return np.mean([x.mean(axis=-1) / y.mean(axis=-1) for x, y in zip(scores, others, strict=True)], axis=0)


class Estimate(NamedTuple):
    """A number or a curve ``[K]``, its interval (``None`` below :data:`MIN_RUNS` runs of a task), and how many runs."""

    value: Array
    low: Array | None
    high: Array | None
    runs: int

    def __format__(self, spec: str) -> str:
        """Return the first number and its interval, if it has one: ``f"{estimate:.2f}"`` is ``0.43 [0.31, 0.52]``."""
        text = f"{self.value[0]:{spec}}"
        if self.low is None or self.high is None:
            return text
        return f"{text} [{self.low[0]:{spec}}, {self.high[0]:{spec}}]"


def estimate(
    statistic: Callable[..., Array],
    *methods: pd.DataFrame,
    columns: Sequence[str] = ("score",),
    replicates: int = REPLICATES,
    seed: int = SEED,
) -> Estimate:
    """Aggregate the runs of one method, or of two to compare, with a two-level stratified bootstrap interval.

    A replicate resamples the encoders, once for all tasks that share them, and then, in place of each run, a downstream
    run of the drawn encoder; tasks are kept (Davison & Hinkley, Bootstrap Methods and their Application, 1997, section
    3.8). If all runs share one encoder, the interval is about that encoder only. Two methods are resampled
    independently, even if they share encoders: their interval is then too wide.

    Args:
        statistic: an aggregate of this module; for two methods one that takes both.
        *methods: a row per run, with columns ``task``, ``encoder`` and ``run`` (names; a run without a pre-trained
            encoder is its own), and the numbers, which are finite. Two methods have the same tasks. A run under several
            tasks is resampled jointly in all of them.
        columns: numbers to aggregate: one score, or the points of a curve.
        replicates: number of bootstrap replicates.
        seed: of the bootstrap.
    """
    samples = [[task for _, task in method.sort_values(["encoder", "run"]).groupby("task")] for method in methods]
    arrays = [[task[list(columns)].to_numpy(float).T for task in sample] for sample in samples]
    value = np.asarray(statistic(*arrays))
    tables = [task for sample in samples for task in sample]
    runs = pd.concat(tables)["run"].nunique()
    if min(map(len, tables)) < MIN_RUNS:
        return Estimate(value, None, None, runs)
    rng = np.random.default_rng(seed)
    resampled = []
    for sample, scores in zip(samples, arrays):
        indices = _resample(sample, replicates, rng)
        resampled.append([task[:, index] for task, index in zip(scores, indices)])  # [K, B, R_t] each
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(statistic(*resampled), [tail, 100 - tail], axis=-1)
    return Estimate(value, low, high, runs)


def _resample(tasks: Sequence[pd.DataFrame], replicates: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Draw encoders with replacement, jointly for the tasks that share them, and then runs of the drawn encoders.

    The first encoder's ``n`` runs become ``n`` runs of the first encoder drawn, resampled with replacement, and so on.
    Tasks with the same runs are resampled jointly. The rows of a task are sorted by encoder. Returns indices
    ``[B, R_t]`` per task.
    """
    encoders = [set(task["encoder"]) for task in tasks]
    is_shared = np.array([[not own.isdisjoint(other) for other in encoders] for own in encoders])
    strata = connected_components(is_shared, directed=False)[1]  # tasks that share encoders, directly or not
    sizes = pd.Series(map(len, encoders)).groupby(strata).max()
    ranks = {stratum: rng.random((replicates, size)) for stratum, size in sizes.items()}
    drawn: dict[tuple, NDArray[np.int64]] = {}
    found = []
    for task, stratum in zip(tasks, strata):
        same = (*task["encoder"], *task["run"])
        if same not in drawn:
            _, place, counts = np.unique(task["encoder"].tolist(), return_inverse=True, return_counts=True)
            chosen = (ranks[stratum][:, : len(counts)] * len(counts)).astype(np.int64)[:, place]  # [B, R]
            nth = (rng.random(chosen.shape) * counts[chosen]).astype(np.int64)
            drawn[same] = (np.cumsum(counts) - counts)[chosen] + nth
        found.append(drawn[same])
    return found

"""Scores of runs and what to say of many of them: pure functions on arrays.

Aggregates take one array per task, ``[..., R]`` with a task's runs along the last axis, and reduce runs and tasks;
axes before it pass through, so that one call serves an estimate, a whole curve, or thousands of bootstrap replicates
(:mod:`crptpro.experiments.bootstrap`). Tasks may differ in their number of runs: every task counts the same.

Source: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, 2021, arXiv 2108.13264,
and its code google-research/rliable, with which all agree where every task has the same number of runs.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Aggregate = Callable[[Sequence[Array]], Array]
"""Reduces one array ``[..., R_t]`` per task to ``[...]``."""

Task = TypeVar("Task", bound=Hashable)


# --- one run --------------------------------------------------------------------------------------------------------


def evaluation_means(env_steps: ArrayLike, episode_returns: ArrayLike) -> tuple[NDArray[np.int64], Array]:
    """Return the mean episode return of every evaluation of a run.

    Args:
        env_steps: ``[N]``, when the evaluation was made that an episode belongs to.
        episode_returns: ``[N]``.

    Returns:
        The evaluations' env steps ``[E]``, ascending, and their means ``[E]``.

    Raises:
        ValueError: no episode, shapes that differ, or a return that is not finite.

    Examples:
        >>> evaluation_means([0, 0, 500], [1.0, 3.0, 8.0])
        (array([  0, 500]), array([2., 8.]))
    """
    steps, returns = np.asarray(env_steps), np.asarray(episode_returns, dtype=np.float64)
    if steps.shape != returns.shape or steps.ndim != 1 or not len(steps):
        raise ValueError(
            f"A run's score needs as many env steps as episode returns, one at least; got shapes {steps.shape} "
            f"and {returns.shape}."
        )
    _require_finite("episode_returns", returns)
    places, inverse, counts = np.unique(steps.astype(np.int64), return_inverse=True, return_counts=True)
    return places, np.bincount(inverse, weights=returns) / counts


def final_score(env_steps: ArrayLike, episode_returns: ArrayLike) -> float:
    """Score a run by the mean return of its final evaluation's episodes.

    What tables show unless they say otherwise. The paper averages "at least 6 different evaluations (60 episodes)" and
    does not say how they divide into seeds and evaluations.

    Args:
        env_steps: ``[N]``, when the evaluation was made that an episode belongs to.
        episode_returns: ``[N]``.

    Raises:
        ValueError: as of :func:`evaluation_means`.
    """
    return float(evaluation_means(env_steps, episode_returns)[1][-1])


def last_evaluations_score(
    env_steps: ArrayLike, episode_returns: ArrayLike, *, evaluations: int = 10
) -> float:
    """Score a run by the mean over its last evaluations: steadier than the final one, and behind it while learning.

    Args:
        env_steps: ``[N]``, when the evaluation was made that an episode belongs to.
        episode_returns: ``[N]``.
        evaluations: how many; each counts the same. All of them if the run has fewer.

    Raises:
        ValueError: as of :func:`evaluation_means`, or ``evaluations`` below 1.
    """
    if evaluations < 1:
        raise ValueError(f"`evaluations` must be at least 1, got {evaluations}.")
    return float(evaluation_means(env_steps, episode_returns)[1][-evaluations:].mean())


def expert_normalized(scores: Mapping[Task, ArrayLike], experts: Mapping[Task, float]) -> dict[Task, Array]:
    """Divide every score by the expert's on the same task.

    ``score / expert``; the random policy's score is not subtracted, as in the paper, whose expert is DrQ
    (:data:`crptpro.experiments.published.EXPERT_SCORES`).

    Args:
        scores: task to scores ``[R]``.
        experts: task to the expert's score; further tasks are ignored.

    Raises:
        ValueError: a task has no expert, or one that is not above 0.
    """
    without = [str(task) for task in scores if task not in experts]
    if without:
        raise ValueError(
            f"There is no expert's score on {', '.join(without)}; give one, or leave the task out."
        )
    for task in scores:
        if not experts[task] > 0 or not np.isfinite(experts[task]):
            raise ValueError(f"An expert's score must be above 0, got {experts[task]} on {task}.")
    return {task: np.asarray(values, dtype=np.float64) / experts[task] for task, values in scores.items()}


# --- many runs ------------------------------------------------------------------------------------------------------


def mean(scores: Sequence[Array]) -> Array:
    """Return the mean over tasks of the mean over a task's runs.

    Args:
        scores: one ``[..., R_t]`` per task.
    """
    return np.mean(_task_means(scores), axis=-1)


def median(scores: Sequence[Array]) -> Array:
    """Return the median over tasks of the mean over a task's runs; with one task, that mean.

    Args:
        scores: one ``[..., R_t]`` per task.
    """
    return np.median(_task_means(scores), axis=-1)


def iqm(scores: Sequence[Array]) -> Array:
    r"""Return the interquartile mean: that of the middle half of all runs of all tasks, sorted together.

    ``floor(R / 4)`` of the ``R`` runs are cut at each end, as rliable does. With unequal counts a run weighs
    ``R / (T R_t)``, so that every task weighs the same, and a run at the cut counts in part.

    Args:
        scores: one ``[..., R_t]`` per task.

    Examples:
        >>> float(iqm([np.array([0.0, 1.0]), np.array([3.0, 100.0])]))
        2.0
    """
    runs = np.concatenate(scores, axis=-1)  # (..., R)
    total = runs.shape[-1]
    cut = total // 4
    weights = np.concatenate([np.full(s.shape[-1], total / (len(scores) * s.shape[-1])) for s in scores])
    if np.allclose(weights, 1):
        return np.sort(runs, axis=-1)[..., cut : total - cut].mean(axis=-1)
    order = np.argsort(runs, axis=-1, kind="stable")
    weight = weights[order]
    end = np.cumsum(weight, axis=-1)  # a run fills the stretch from `end - weight` to `end` of [0, R]
    kept = np.clip(np.minimum(end, total - cut) - np.maximum(end - weight, cut), 0, None)
    return (kept * np.take_along_axis(runs, order, axis=-1)).sum(axis=-1) / kept.sum(axis=-1)


def optimality_gap(scores: Sequence[Array], *, target: float = 1.0) -> Array:
    """Return by how much runs fall short of ``target`` on average; more than the target makes up for nothing.

    ``mean over tasks of mean over runs of max(target - score, 0)``; lower is better.

    Args:
        scores: one ``[..., R_t]`` per task, normalised so that ``target`` means the same on all.
        target: what is enough; 1 is the expert.
    """
    return mean([np.maximum(target - s, 0.0) for s in scores])


def performance_profile(scores: Sequence[Array], thresholds: ArrayLike) -> Array:
    """Return the fraction of runs that score above each threshold, every task counting the same.

    ``F(t) = mean over tasks of mean over runs of [score > t]`` (a run-score distribution).

    Args:
        scores: one ``[..., R_t]`` per task.
        thresholds: ``[K]``.

    Returns:
        Fractions ``[..., K]`` in [0, 1], not increasing in the threshold.
    """
    marks = np.asarray(thresholds, dtype=np.float64)
    # One threshold at a time: replicates x runs x thresholds would be large.
    return np.stack([mean([s > mark for s in scores]) for mark in marks], axis=-1)


def probability_of_improvement(scores: Sequence[Array], others: Sequence[Array]) -> Array:
    """Return how probably a run of one method beats one of another on the same task, averaged over tasks.

    ``P(X > Y) + P(X = Y) / 2`` over all pairs of runs: the Mann-Whitney U statistic over ``R_x R_y``. Half means no
    difference. It says nothing about by how much.

    Args:
        scores: one ``[..., R_t]`` per task, method X.
        others: one ``[..., S_t]`` per task, method Y, in the same order of tasks.

    Raises:
        ValueError: the numbers of tasks differ.
    """
    if len(scores) != len(others):
        raise ValueError(f"Both methods need the same tasks, got {len(scores)} and {len(others)} of them.")
    wins = []
    for x, y in zip(scores, others):
        difference = x[..., :, None] - y[..., None, :]  # (..., R, S)
        wins.append(((np.sign(difference) + 1) / 2).mean(axis=(-2, -1)))
    return np.mean(np.stack(wins, axis=-1), axis=-1)


def _task_means(scores: Sequence[Array]) -> Array:
    return np.stack([s.mean(axis=-1) for s in scores], axis=-1)  # (..., T)


def _require_finite(name: str, values: Array) -> None:
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        index = tuple(int(i) for i in wrong[0])
        raise ValueError(
            f"{name}{list(index)} is {values[index]}. A run that diverged has no score: leave it out and say so."
        )

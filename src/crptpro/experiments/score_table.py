"""From runs to arrays: the scores of one method, by task, with the encoder of every run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from crptpro.experiments.records import Run
from crptpro.experiments.statistics import Array

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScoreTable:
    """One method's runs.

    Args:
        scores: task (or whatever the runs were keyed by) to one score per run ``[R]``.
        encoders: the same keys to the encoder of each run; ``None`` if one is not known, and then only intervals over
            runs can be had. A run that trains its encoder counts as having its own.
    """

    scores: Mapping[Any, Array]
    encoders: Mapping[Any, tuple[str, ...]] | None

    def only(self, tasks: Iterable[Hashable]) -> ScoreTable:
        """Return the part on some of the tasks.

        Raises:
            KeyError: if there is one without runs.
        """
        kept = list(tasks)
        encoders = None if self.encoders is None else {task: self.encoders[task] for task in kept}
        return ScoreTable({task: self.scores[task] for task in kept}, encoders)


def score_tables(
    runs: Iterable[Run],
    *,
    score: Callable[[Run], float] = lambda run: run.final_score,
    key: Callable[[Run], Hashable] = lambda run: run.task,
) -> dict[str, ScoreTable]:
    """Sort runs into one table per method.

    Args:
        runs: as found, finished ones.
        score: of a run; by default the mean of its final evaluation.
        key: what a run is compared under; by default its task. A table over several groups needs the group in it.

    Returns:
        Method to table, in the order of names.
    """
    by_method: dict[str, dict[Hashable, list[Run]]] = {}
    for run in runs:
        by_method.setdefault(run.method, {}).setdefault(key(run), []).append(run)
    return {method: _table(method, by_key, score) for method, by_key in sorted(by_method.items())}


def shared_tasks(tables: Mapping[str, ScoreTable]) -> list[Any]:
    """Return the tasks on which every method has runs, and name the others in a warning.

    Aggregates over different tasks do not compare.

    Args:
        tables: method to table.
    """
    everywhere = sorted({task for table in tables.values() for task in table.scores}, key=str)
    lacking = {t: [m for m, table in tables.items() if t not in table.scores] for t in everywhere}
    for task, methods in lacking.items():
        if methods:
            logger.warning("%s is left out of comparisons: no run of %s.", task, ", ".join(methods))
    return [task for task in everywhere if not lacking[task]]


def _table(method: str, by_key: Mapping[Hashable, list[Run]], score: Callable[[Run], float]) -> ScoreTable:
    scores = {key: np.array([score(run) for run in runs]) for key, runs in by_key.items()}
    unknown = [
        run for runs in by_key.values() for run in runs if run.encoder is None and not run.trains_encoder
    ]
    if unknown:
        logger.warning(
            "The encoder of %d run(s) of %s is not recorded, the first in %s: intervals over runs only.",
            len(unknown), method, unknown[0].directory,
        )  # fmt: skip
        return ScoreTable(scores, None)
    encoders = {
        key: tuple(run.encoder or f"own:{run.directory}" for run in runs) for key, runs in by_key.items()
    }
    return ScoreTable(scores, encoders)

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
        runs: the same keys to what each run is called; one that stands under two keys has one name.
    """

    scores: Mapping[Any, Array]
    encoders: Mapping[Any, tuple[str, ...]] | None
    runs: Mapping[Any, tuple[str, ...]]

    @property
    def count(self) -> int:
        """Number of different runs."""
        return len({name for names in self.runs.values() for name in names})

    @property
    def shares_encoders(self) -> bool:
        """Whether an interval over encoders can be had and differs from one over runs.

        It needs two encoders on every task, and is the same where every run has an encoder that no other has.
        """
        if self.encoders is None or any(len(set(labels)) < 2 for labels in self.encoders.values()):
            return False
        return self.is_about_its_encoders

    @property
    def shared_encoders(self) -> Mapping[Any, tuple[str, ...]] | None:
        """The encoders over which an interval is to be had: those of the runs if they share them, else ``None``."""
        return self.encoders if self.shares_encoders else None

    @property
    def is_about_its_encoders(self) -> bool:
        """Whether an interval over runs speaks of these encoders and not of the method that made them.

        It does where runs share encoders, or where it is not known whether they do.
        """
        if self.encoders is None:
            return True
        return len({label for labels in self.encoders.values() for label in labels}) < self.count

    def only(self, tasks: Iterable[Hashable]) -> ScoreTable:
        """Return the part on some of the tasks.

        Raises:
            KeyError: if there is one without runs.
        """
        kept = list(tasks)
        encoders = None if self.encoders is None else {task: self.encoders[task] for task in kept}
        runs = {task: self.runs[task] for task in kept}
        return ScoreTable({task: self.scores[task] for task in kept}, encoders, runs)


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


def _table(method: str, by_key: Mapping[Hashable, list[Run]], score: Callable[[Run], float]) -> ScoreTable:
    scores = {key: np.array([score(run) for run in runs]) for key, runs in by_key.items()}
    names = {key: tuple(str(run.directory) for run in runs) for key, runs in by_key.items()}
    unknown = [
        run for runs in by_key.values() for run in runs if run.encoder is None and not run.trains_encoder
    ]
    if unknown:
        logger.warning(
            "The encoder of %d run(s) of %s is not recorded, the first in %s: intervals over runs only.",
            len(unknown), method, unknown[0].directory,
        )  # fmt: skip
        return ScoreTable(scores, None, names)
    encoders = {
        key: tuple(run.encoder or f"own:{run.directory}" for run in runs) for key, runs in by_key.items()
    }
    return ScoreTable(scores, encoders, names)

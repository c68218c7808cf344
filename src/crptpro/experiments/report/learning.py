"""Learning curves, against env steps and against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from crptpro.errors import RecordError
from crptpro.experiments.estimates import estimate_curve
from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.records import Run
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import Block, Figure, numbered
from crptpro.experiments.report.palette import Style, styles
from crptpro.experiments.report.reading import number
from crptpro.experiments.report.runs import Placed, Spot, labels_of, spots_of
from crptpro.experiments.row_files import read_rows
from crptpro.experiments.score_table import score_tables
from crptpro.experiments.statistics import Array, evaluation_means, mean

PAUSE_S, PAUSE_FACTOR = 600.0, 20.0
STREAMS = ("eval", "train", "episodes")


def learning_curves(placed: Sequence[Placed], name: str, bootstrap: Bootstrap) -> list[Block]:
    """Draw mean episode return along training, a panel per row of the score table.

    Args:
        placed: finished runs.
        name: for the names of figures.
        bootstrap: how intervals are made.
    """
    labels, look = labels_of(placed), styles(labels_of(placed))
    spots = spots_of(placed)
    grouped = {
        (spot, label): [p.run for p in placed if (p.spot, p.label) == (spot, label)]
        for spot in spots
        for label in labels
    }
    counts = {
        label: [len(grouped[spot, label]) for spot in spots if grouped[spot, label]] for label in labels
    }
    named = {label: f"{label} ({numbered(counts[label])})" for label in labels}
    by_env_steps, by_hours = [], []
    for spot in spots:
        here = {label: grouped[spot, label] for label in labels if grouped[spot, label]}
        by_env_steps.append(_panel(spot, "env steps", here, look, named, bootstrap))
        by_hours.append(_panel(spot, "hours", here, look, named, bootstrap))
    band = (
        f"{bootstrap.confidence:.0%} bootstrap intervals, over encoders where runs of a panel share several, else over "
        "runs where there are two or more"
    )
    return [
        Figure(
            f"{name}-curves",
            f"Episode return along training: mean over runs (n per panel in the legend), {band}.",
            drawing.lines(by_env_steps),
        ),
        Figure(
            f"{name}-curves-time",
            "The same against the time since a run's first record, mean over runs (n in the legend). Pauses of a run "
            "that was continued do not count: what is longer than ten minutes and than twenty usual distances between "
            "records counts as one of these. Times compare only within one machine, and runs that shared it slowed "
            "each other down.",
            drawing.lines(by_hours),
        ),
    ]


def common_curve(runs: Sequence[Run]) -> tuple[Array, Array]:
    """Return the evaluations that all runs have: env steps ``[K]`` and mean returns ``[R, K]``."""
    curves = [dict(zip(*(part.tolist() for part in evaluation_means(*_columns(run))))) for run in runs]
    shared = sorted(set.intersection(*(set(curve) for curve in curves)))
    return np.array(shared, dtype=float), np.array([[curve[at] for at in shared] for curve in curves])


def active_seconds(run: Run) -> dict[int, float]:
    """Return how long a run had been at work when each of its evaluations was recorded.

    Time counts from the first record; a pause between two records that is longer than ten minutes and than twenty
    times their median distance is taken for the time in which an interrupted run did not run, and counts as one usual
    distance.

    Args:
        run: as read.

    Returns:
        Env steps of an evaluation to seconds.
    """
    ends = {episode.env_steps: episode.unix_time_s for episode in run.episodes}
    marks = np.unique([*ends.values(), *_marks(run)])
    distances = np.diff(marks)
    usual = np.median(distances[distances > 1]) if (distances > 1).any() else 0.0
    is_pause = distances > max(PAUSE_S, PAUSE_FACTOR * usual)
    worked = np.concatenate([[0.0], np.cumsum(np.where(is_pause, usual, distances))])
    return {at: float(worked[np.searchsorted(marks, end)]) for at, end in ends.items()}


def _marks(run: Run) -> list[float]:
    found = []
    for stream in STREAMS:
        try:
            rows = read_rows(run.directory / f"{stream}.csv")
        except RecordError:
            continue  # a run without training rows has its evaluations
        found += [at for row in rows if (at := number(row, "unix_time_s")) is not None]
    return found


def _panel(
    spot: Spot,
    unit: str,
    runs: Mapping[str, list[Run]],
    look: Mapping[str, Style],
    named: Mapping[str, str],
    bootstrap: Bootstrap,
) -> drawing.Panel:
    curves = []
    for label, own in runs.items():
        env_steps, returns = common_curve(own)
        if not len(env_steps):
            continue
        (table,) = score_tables(own, key=lambda _: spot).values()
        encoders = table.shared_encoders
        found = estimate_curve(env_steps, {spot: returns}, mean, encoders=encoders, bootstrap=bootstrap)
        x = env_steps
        if unit == "hours":
            x = np.mean([[active_seconds(run)[int(at)] / 3600 for at in env_steps] for run in own], axis=0)
        curves.append(drawing.Line(named[label], look[label], x, found.values, found.low, found.high))
    return drawing.Panel(str(spot), unit, "episode return", curves)


def _columns(run: Run) -> tuple[list[int], list[float]]:
    return [e.env_steps for e in run.episodes], [e.episode_return for e in run.episodes]

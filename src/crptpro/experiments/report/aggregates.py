"""Many runs in one number per method, with intervals: what a table of means cannot tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crptpro.experiments.bootstrap import COVERAGE, ENOUGH_DRAWS
from crptpro.experiments.estimates import (
    estimate,
    estimate_improvement,
    estimate_profile,
    estimate_relative,
)
from crptpro.experiments.intervals import Bootstrap, Estimate
from crptpro.experiments.published import EXPERT_SCORES, SEEN, SEEN_MEAN, SEEN_NORMALIZED_MEAN
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import Block, Cell, Figure, Paragraph, Table, cells, counted
from crptpro.experiments.report.palette import styles
from crptpro.experiments.report.runs import Placed, Spot, published, tables_of
from crptpro.experiments.score_table import ScoreTable
from crptpro.experiments.statistics import expert_normalized, iqm, mean, median, optimality_gap

DRQ = "drq"
REFERENCE = "crptpro"
"""The method that others are compared with."""


def aggregates(placed: Sequence[Placed], name: str, bootstrap: Bootstrap) -> list[Block]:
    """Aggregate over the tasks on which every method has runs.

    Args:
        placed: finished runs.
        name: for the names of figures.
        bootstrap: how intervals are made.
    """
    tables = tables_of(placed)
    everywhere = sorted({spot for table in tables.values() for spot in table.scores})
    shared = [spot for spot in everywhere if all(spot in table.scores for table in tables.values())]
    blocks: list[Block] = []
    if len(shared) < len(everywhere):
        lacking = "; ".join(
            f"{spot} (no run of {', '.join(label for label, t in tables.items() if spot not in t.scores)})"
            for spot in everywhere
            if spot not in shared
        )
        blocks.append(Paragraph(f"Left out of everything that compares methods: {lacking}.", "note"))
    if not shared:
        blocks.append(
            Paragraph("There is no task on which every method has a run: nothing to aggregate.", "note")
        )
        return blocks
    kept = {label: table.only(shared) for label, table in tables.items()}
    blocks += _tables(kept, shared, bootstrap)
    normalizable = [spot for spot in shared if spot.task in EXPERT_SCORES]
    if normalizable:
        normalized = {label: _normalized(table.only(normalizable)) for label, table in kept.items()}
        blocks += _improvement(normalized, name, bootstrap)
        if not any(p.varied[0] for p in placed):  # a dozen values of one setting would hide each other
            blocks.append(_profiles(normalized, name, bootstrap))
    return blocks


def _normalized(table: ScoreTable) -> ScoreTable:
    experts = {spot: EXPERT_SCORES[spot.task] for spot in table.scores}
    return ScoreTable(expert_normalized(table.scores, experts), table.encoders, table.runs)


def _tables(tables: Mapping[str, ScoreTable], shared: Sequence[Spot], bootstrap: Bootstrap) -> list[Block]:
    normalizable = [spot for spot in shared if spot.task in EXPERT_SCORES]
    here = _measures_against_drq(tables)
    how = f"{bootstrap.replicates:,} stratified bootstrap replicates, seed {bootstrap.seed}"
    rows = []
    for label, table in tables.items():
        row: list[str | Cell] = [label, str(len(table.scores)), str(table.count)]
        found = estimate(table.scores, mean, runs=table.runs, bootstrap=bootstrap)
        row.append(_with_interval(found, ".0f", _paper_mean(shared, label)))
        row += _normalized_cells(table, normalizable, label, bootstrap, None)
        if here:
            row.append(_against_drq(table, tables[DRQ], bootstrap) if label != DRQ else _BY_DEFINITION)
        rows.append(cells(*row))
    columns = ["method", "tasks", "runs", "mean score", *(_NORMALIZED if normalizable else ())]
    columns += ["mean / DrQ here"] * bool(here)
    caption = (
        f"Over the {counted(len(shared), 'task')} that all methods share; {bootstrap.confidence:.0%} intervals over "
        f"runs, {how}. A task counts once per group and colours, a run of several once. Normalised scores are divided "
        "by the paper's DrQ."
    )
    if any(label in SEEN_MEAN for label in tables) and set(shared) != _SEEN_SPOTS:
        caption += " “paper” is what its cells for these tasks give."
    if here:
        caption += " DrQ here has few runs itself: they are redrawn with the others', so that the intervals know of it."
    blocks: list[Block] = [Table(caption, tuple(columns), tuple(rows))]
    if len(normalizable) < len(shared):
        blocks.append(
            Paragraph(
                "The paper has no DrQ score for "
                f"{', '.join(sorted({s.task for s in shared if s not in normalizable}))}: these are in the mean score "
                "only.",
                "note",
            )
        )
    blocks += _over_encoders(tables, shared, bootstrap, how)
    fewest = min(len(scores) for table in tables.values() for scores in table.scores.values())
    if fewest < ENOUGH_DRAWS:
        held = "; ".join(f"{count}: {share:.0%}" for count, share in COVERAGE.items())
        text = (
            f"Tasks have as few as {counted(fewest, 'run')}, and bootstrap intervals of few draws are too narrow: one "
            "of two is their range. Where runs follow a normal law, 95% intervals of a single task's mean hold the "
            f"truth, by number of runs, {held}. The same holds for encoders."
        )
        blocks.append(Paragraph(text, "warning"))
    return blocks


_NORMALIZED = ("mean / DrQ", "IQM / DrQ", "median / DrQ", "optimality gap")
_BY_DEFINITION = Cell("1", "by definition")
_SEEN_SPOTS = {Spot(row.group, row.task) for row in SEEN}


def _normalized_cells(
    table: ScoreTable, spots: Sequence[Spot], label: str, bootstrap: Bootstrap, encoders: Mapping | None
) -> list[Cell]:
    if not spots:
        return []
    own = _normalized(table.only(spots))
    found = []
    for aggregate in (mean, iqm, median, optimality_gap):
        paper = _paper_normalized(spots, label) if aggregate is mean and encoders is None else ""
        made = estimate(own.scores, aggregate, encoders=encoders, runs=own.runs, bootstrap=bootstrap)
        found.append(_with_interval(made, ".3f", paper))
    return found


def _over_encoders(
    tables: Mapping[str, ScoreTable], shared: Sequence[Spot], bootstrap: Bootstrap, how: str
) -> list[Block]:
    """The same numbers with wider intervals, for methods whose runs share encoders."""
    spots = [spot for spot in shared if spot.task in EXPERT_SCORES]
    here = _measures_against_drq(tables)
    rows = []
    for label, table in tables.items():
        told = table.shared_encoders
        if told is None:
            continue
        count = len({encoder for encoders in told.values() for encoder in encoders})
        found = estimate(table.scores, mean, encoders=told, runs=table.runs, bootstrap=bootstrap)
        row: list[str | Cell] = [label, str(count), _with_interval(found, ".0f")]
        row += _normalized_cells(table, spots, label, bootstrap, {spot: told[spot] for spot in spots})
        if here:
            row.append(_against_drq(table, tables[DRQ], bootstrap, told))
        rows.append(cells(*row))
    blocks: list[Block] = []
    if rows:
        caption = (
            f"The same where runs share encoders: {bootstrap.confidence:.0%} intervals over encoders, {how}."
        )
        columns = ("method", "encoders", "mean score", *(_NORMALIZED if spots else ()))
        blocks.append(Table(caption, (*columns, *["mean / DrQ here"] * here), tuple(rows)))
    of_these = [t for t, table in tables.items() if table.is_about_its_encoders and not table.shares_encoders]
    if of_these:
        text = (
            f"The intervals of {', '.join(of_these)} are over runs alone, and speak of these encoders: one that speaks "
            "of the method needs two encoders or more on every task."
        )
        blocks.append(Paragraph(text, "note"))
    return blocks


def _improvement(tables: Mapping[str, ScoreTable], name: str, bootstrap: Bootstrap) -> list[Block]:
    if REFERENCE not in tables or len(tables) < 2:
        return []
    ours, drawn, rows = tables[REFERENCE], [], []
    look = styles(tables)
    for label, table in tables.items():
        if label == REFERENCE:
            continue
        level: dict[str, Any] = {}
        if _has_encoders(ours, table):
            level = {"encoders": ours.encoders, "other_encoders": table.encoders}
        found = estimate_improvement(
            ours.scores, table.scores, runs=ours.runs, other_runs=table.runs, bootstrap=bootstrap, **level
        )
        rows.append(cells(label, str(found.basis.runs), found.basis.level, _with_interval(found, ".2f")))
        drawn.append((label, look[label], found.value, found.interval))
    caption = (
        f"Probability that a run of {REFERENCE} scores higher than one of the other method on the same task; "
        f"{bootstrap.confidence:.0%} intervals, over encoders where both methods have two or more on every task and "
        "one of them shares some among its runs, else over runs."
    )
    picture = drawing.intervals(drawn, f"P({REFERENCE} > other); 0.5: no difference", 0.5)
    runs = _runs(tables)
    return [
        Table(
            caption,
            ("other method", "runs of both", "interval over", f"P({REFERENCE} > other)"),
            tuple(rows),
        ),
        Figure(f"{name}-improvement", f"{caption} {runs} runs in all.", picture),
    ]


def _has_encoders(*tables: ScoreTable) -> bool:
    """Whether an interval over the encoders of all of these can be had, and differs from one over runs."""
    told = [labels for table in tables for labels in (table.encoders or {"": ()}).values()]
    return all(len(set(labels)) > 1 for labels in told) and any(table.shares_encoders for table in tables)


def _profiles(tables: Mapping[str, ScoreTable], name: str, bootstrap: Bootstrap) -> Figure:
    top = max(float(np.max(scores)) for table in tables.values() for scores in table.scores.values())
    thresholds = np.linspace(0, max(min(top * 1.05, 4.0), 0.05), 61)
    look = styles(tables)
    curves = []
    for label, table in tables.items():
        encoders = table.shared_encoders
        found = estimate_profile(
            table.scores, thresholds, encoders=encoders, runs=table.runs, bootstrap=bootstrap
        )
        count = f"n = {found.basis.runs}" + (f" on {found.basis.encoders} encoders" if encoders else "")
        curves.append(
            drawing.Line(f"{label} ({count})", look[label], found.x, found.values, found.low, found.high)
        )
    panel = drawing.Panel("", "score / the paper's DrQ", "fraction of runs above it", curves)
    caption = (
        f"Performance profiles with {bootstrap.confidence:.0%} intervals, over encoders where the legend counts them, "
        "else over runs; n counts runs of all tasks."
    )
    return Figure(f"{name}-profiles", caption, drawing.lines([panel]))


def _measures_against_drq(tables: Mapping[str, ScoreTable]) -> bool:
    """Whether DrQ was measured here, and every one of its runs has a score to divide by."""
    return DRQ in tables and all(float(np.min(scores)) > 0 for scores in tables[DRQ].scores.values())


def _against_drq(
    table: ScoreTable, drq: ScoreTable, bootstrap: Bootstrap, encoders: Mapping | None = None
) -> Cell:
    found = estimate_relative(
        table.scores,
        drq.scores,
        encoders=encoders,
        runs=table.runs,
        reference_runs=drq.runs,
        bootstrap=bootstrap,
    )
    return _with_interval(found, ".3f")


def _paper_mean(spots: Sequence[Spot], label: str) -> str:
    if set(spots) == _SEEN_SPOTS and label in SEEN_MEAN:
        return f"{SEEN_MEAN[label]:g}"
    found = [published(spot, label) for spot in spots]
    scores = [score.mean for score in found if score is not None]
    return f"{np.mean(scores):.0f}" if len(scores) == len(spots) else ""


def _paper_normalized(spots: Sequence[Spot], label: str) -> str:
    """What the paper printed for all of its tasks; for a part of them, what its cells give."""
    if set(spots) == _SEEN_SPOTS and label in SEEN_NORMALIZED_MEAN:
        return f"{SEEN_NORMALIZED_MEAN[label]:.3f}"
    found = [(published(spot, label), EXPERT_SCORES[spot.task]) for spot in spots]
    ratios = [score.mean / expert for score, expert in found if score is not None]
    return f"{np.mean(ratios):.3f}" if len(ratios) == len(spots) else ""


def _with_interval(found: Estimate, spec: str, paper: str = "") -> Cell:
    if found.interval is None:
        return Cell(f"{found.value:{spec}}", "no interval: single runs", paper)
    return Cell(f"{found.value:{spec}}", f"[{found.interval[0]:{spec}}, {found.interval[1]:{spec}}]", paper)


def _runs(tables: Mapping[str, ScoreTable]) -> int:
    return sum(table.count for table in tables.values())

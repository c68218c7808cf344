"""Many runs in one number per method, with intervals: what a table of means cannot tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from crptpro.experiments.estimates import estimate, estimate_improvement, estimate_profile
from crptpro.experiments.intervals import Bootstrap, Estimate
from crptpro.experiments.published import EXPERT_SCORES
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import Block, Cell, Figure, Paragraph, Table, cells
from crptpro.experiments.report.palette import styles
from crptpro.experiments.report.runs import Placed, Spot, published, tables_of
from crptpro.experiments.score_table import ScoreTable
from crptpro.experiments.statistics import expert_normalized, iqm, mean, median, optimality_gap

REFERENCE = "crptpro"
"""The method that others are compared with."""


def aggregates(placed: Sequence[Placed], name: str, bootstrap: Bootstrap) -> list[Block]:
    """Aggregate over the rows on which every method has runs.

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
    return ScoreTable(expert_normalized(table.scores, experts), table.encoders)


def _tables(tables: Mapping[str, ScoreTable], shared: Sequence[Spot], bootstrap: Bootstrap) -> list[Block]:
    normalizable = [spot for spot in shared if spot.task in EXPERT_SCORES]
    here = _experts_here(tables, shared)
    how = f"{bootstrap.replicates:,} stratified bootstrap replicates, seed {bootstrap.seed}"
    rows = []
    for label, table in tables.items():
        row: list[str | Cell] = [label, *_counts(table)]
        row.append(
            _with_interval(
                estimate(table.scores, mean, bootstrap=bootstrap), ".0f", _paper_mean(shared, label)
            )
        )
        row += _normalized_cells(table, normalizable, label, bootstrap, None)
        if here:
            own = estimate(expert_normalized(table.scores, here), mean, bootstrap=bootstrap)
            row.append(_with_interval(own, ".3f"))
        rows.append(cells(*row))
    columns = ["method", "rows", "runs", "mean score", *(_NORMALIZED if normalizable else ())]
    columns += ["mean / DrQ here"] * bool(here)
    caption = (
        f"Over the {len(shared)} row(s) that all methods share; {bootstrap.confidence:.0%} intervals over runs, {how}. "
        "Normalised scores are divided by the paper's DrQ."
    )
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
    return blocks + _over_encoders(tables, normalizable, bootstrap, how)


_NORMALIZED = ("mean / DrQ", "IQM / DrQ", "median / DrQ", "optimality gap")


def _normalized_cells(
    table: ScoreTable, spots: Sequence[Spot], label: str, bootstrap: Bootstrap, encoders: Mapping | None
) -> list[Cell]:
    if not spots:
        return []
    scores = _normalized(table.only(spots)).scores
    found = []
    for aggregate in (mean, iqm, median, optimality_gap):
        paper = _paper_normalized(spots, label) if aggregate is mean and encoders is None else ""
        found.append(
            _with_interval(estimate(scores, aggregate, encoders=encoders, bootstrap=bootstrap), ".3f", paper)
        )
    return found


def _over_encoders(
    tables: Mapping[str, ScoreTable], spots: Sequence[Spot], bootstrap: Bootstrap, how: str
) -> list[Block]:
    """The same numbers with wider intervals, for methods whose runs share encoders."""
    if not spots:
        return []
    rows = []
    for label, table in tables.items():
        told = table.only(spots).encoders
        if told is None or any(len(set(encoders)) < 2 for encoders in told.values()):
            continue
        if all(len(set(encoders)) == len(encoders) for encoders in told.values()):
            own = {encoder for encoders in told.values() for encoder in encoders}
            if len(own) == sum(len(encoders) for encoders in told.values()):
                continue  # every run has an encoder that no other has: the same as over runs
        count = len({encoder for encoders in told.values() for encoder in encoders})
        rows.append(cells(label, str(count), *_normalized_cells(table, spots, label, bootstrap, told)))
    if not rows:
        text = (
            "Intervals are over runs, and speak of these encoders: no method has runs on two encoders or more that "
            "runs share on every row, which an interval over encoders would need."
        )
        return [Paragraph(text, "note")]
    caption = (
        f"The same where runs share encoders: {bootstrap.confidence:.0%} intervals over encoders, {how}."
    )
    return [Table(caption, ("method", "encoders", *_NORMALIZED), tuple(rows))]


def _improvement(tables: Mapping[str, ScoreTable], name: str, bootstrap: Bootstrap) -> list[Block]:
    if REFERENCE not in tables or len(tables) < 2:
        return []
    ours, drawn, rows = tables[REFERENCE], [], []
    look = styles(tables)
    for label, table in tables.items():
        if label == REFERENCE:
            continue
        found = estimate_improvement(ours.scores, table.scores, bootstrap=bootstrap)
        rows.append(cells(label, str(found.basis.runs), _with_interval(found, ".2f")))
        drawn.append((label, look[label], found.value, found.interval))
    caption = (
        f"Probability that a run of {REFERENCE} scores higher than one of the other method on the same task."
    )
    picture = drawing.intervals(drawn, f"P({REFERENCE} > other); 0.5: no difference", 0.5)
    runs = _runs(tables)
    return [
        Table(caption, ("other method", "runs of both", f"P({REFERENCE} > other)"), tuple(rows)),
        Figure(f"{name}-improvement", f"{caption} {runs} runs in all.", picture),
    ]


def _profiles(tables: Mapping[str, ScoreTable], name: str, bootstrap: Bootstrap) -> Figure:
    top = max(float(np.max(scores)) for table in tables.values() for scores in table.scores.values())
    thresholds = np.linspace(0, max(min(top * 1.05, 4.0), 0.05), 61)
    look = styles(tables)
    curves = []
    for label, table in tables.items():
        found = estimate_profile(table.scores, thresholds, bootstrap=bootstrap)
        runs = found.basis.runs
        curves.append(
            drawing.Line(f"{label} (n = {runs})", look[label], found.x, found.values, found.low, found.high)
        )
    panel = drawing.Panel("", "score / the paper's DrQ", "fraction of runs above it", curves)
    caption = f"Performance profiles with {bootstrap.confidence:.0%} intervals over runs; n counts runs of all rows."
    return Figure(f"{name}-profiles", caption, drawing.lines([panel]))


def _experts_here(tables: Mapping[str, ScoreTable], shared: Sequence[Spot]) -> dict[Spot, float]:
    """DrQ's mean as measured here, if it was, and is above 0 on every row."""
    if "drq" not in tables:
        return {}
    means = {spot: float(np.mean(tables["drq"].scores[spot])) for spot in shared}
    return means if all(value > 0 for value in means.values()) else {}


def _counts(table: ScoreTable) -> list[str]:
    return [str(len(table.scores)), str(sum(len(scores) for scores in table.scores.values()))]


def _paper_mean(spots: Sequence[Spot], label: str) -> str:
    found = [published(spot, label) for spot in spots]
    scores = [score.mean for score in found if score is not None]
    return f"{np.mean(scores):.0f}" if len(scores) == len(spots) else ""


def _paper_normalized(spots: Sequence[Spot], label: str) -> str:
    found = [(published(spot, label), EXPERT_SCORES[spot.task]) for spot in spots]
    ratios = [score.mean / expert for score, expert in found if score is not None]
    return f"{np.mean(ratios):.3f}" if len(ratios) == len(spots) else ""


def _with_interval(found: Estimate, spec: str, paper: str = "") -> Cell:
    if found.interval is None:
        return Cell(f"{found.value:{spec}}", "no interval: single runs", paper)
    return Cell(f"{found.value:{spec}}", f"[{found.interval[0]:{spec}}, {found.interval[1]:{spec}}]", paper)


def _runs(tables: Mapping[str, ScoreTable]) -> int:
    return sum(len(scores) for table in tables.values() for scores in table.scores.values())

"""One-factor trials of pre-training: diagnostics, probes and scores by the value of what was changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Heading, Table, sentence
from crptpro.experiments.report.diagnostics import diagnostics, group_of, groups_of, records_of
from crptpro.experiments.report.measurements import Row, rows_of
from crptpro.experiments.report.palette import in_order, styles
from crptpro.experiments.report.reading import Asked, Wanted

READ = {"r2_position": "positions", "r2_velocity": "velocities"}
CONTROL = "control"
"""The factor of an untrained encoder, which stands in the tables of every other."""


def study(asked: Asked) -> tuple[Block, ...]:
    """Report, for each factor and group, final diagnostics, curves and probes by value.

    A goal's place names its ``factor`` and ``value``, its ``group``, and ``updates`` if an encoder was probed along its
    training.
    """
    probes, blocks = rows_of(asked, "probe")
    probes = [row for row in probes if not row["coordinate"] and row["measure"] in READ]
    records = records_of(asked)
    factors = list(dict.fromkeys(_factor(goal) for goal in asked.finished if goal.piece.kind != "run"))
    for number, factor in enumerate(factors):
        if factor == CONTROL and len(factors) > 1:
            continue
        goals = [goal for goal in asked.finished if _factor(goal) == factor]
        for group in groups_of(goals):
            of = ", ".join(part for part in (_words(factor), f"group {group}" * bool(group)) if part)
            if of:
                blocks.append(Heading(sentence(of)))
                of = f"{of}: "
            heading = _words(factor) or "variant"
            name = f"{asked.name}-{number + 1}{group}"
            own = [
                (goal, rows) for goal, rows in records if (_factor(goal), group_of(goal)) == (factor, group)
            ]
            read = [
                row
                for row in probes
                if _factor(row.goal) in (factor, CONTROL) and group_of(row.goal) == group
            ]
            if own:
                blocks += diagnostics(own, _value, heading, name, of)
            if read:
                blocks.append(_table(read, heading, of))
                blocks += _along(read, f"{name}-probe", of)
    return tuple(blocks)


def _table(rows: Sequence[Row], heading: str, of: str) -> Table:
    last = {key: max(_updates(r) for r in rows if _encoder(r) == key) for key in {_encoder(r) for r in rows}}
    ends = [row for row in rows if _updates(row) == last[_encoder(row)]]
    columns = list(dict.fromkeys(_column(row) for row in ends))
    lines = []
    ends.sort(key=lambda row: _factor(row.goal) == CONTROL)
    for label in in_order(_value(row.goal) for row in ends):
        line = [Cell(label)]
        for column in columns:
            own = [row for row in ends if _value(row.goal) == label and _column(row) == column]
            values = [value for row in own if (value := row.number("value")) is not None]
            spread = f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 else ""
            told = Cell(f"{np.mean(values):.3f}{spread}", f"n = {len(values)}") if values else Cell(ABSENT)
            line.append(told)
        lines.append(tuple(line))
    caption = f"{of}state probe at the end, R2 on held-out episodes, mean over encoders (n)."
    return Table(sentence(caption), (heading, *columns), tuple(lines))


def _along(rows: Sequence[Row], name: str, of: str) -> list[Block]:
    """R2 of velocities along training, from features; nothing where encoders were probed at their end alone."""
    rows = [row for row in rows if row["measure"] == "r2_velocity" and row["embedding"] == "features"]
    trained = [row for row in rows if _factor(row.goal) != CONTROL]
    if len({_updates(row) for row in trained}) < 2:
        return []
    labels = in_order(_value(row.goal) for row in trained)
    look, panels = styles(labels), []
    for column in dict.fromkeys(_column(row) for row in trained):
        here = [row for row in trained if _column(row) == column]
        curves = []
        for label in labels:
            own = [row for row in here if _value(row.goal) == label]
            places = sorted({_updates(row) for row in own})
            read = [[r.number("value") for r in own if _updates(r) == at] for at in places]
            means = [np.mean([np.nan if value is None else value for value in part]) for part in read]
            encoders = len({_encoder(row) for row in own})
            curves.append(drawing.Line(f"{label} (n = {encoders})", look[label], places, means))
        untrained = [r.number("value") for r in rows if _factor(r.goal) == CONTROL and _column(r) == column]
        known = [value for value in untrained if value is not None]
        marks = {"untrained": float(np.mean(known))} if known else {}
        panels.append(
            drawing.Panel(column.split(",")[0], "encoder updates", "R2 of velocities", curves, marks)
        )
    caption = f"{of}state probe of the features along training, mean over encoders (n in the legend)."
    return [Figure(name, sentence(caption), drawing.lines(panels, columns=2))]


def _factor(goal: Wanted) -> str:
    return str(goal.place.get("factor", ""))


def _words(name: str) -> str:
    return name.replace("_", " ")


def _value(goal: Wanted) -> str:
    return str(goal.place.get("value", goal.label))


def _updates(row: Row) -> float:
    return float(row.goal.place.get("updates", 0))


def _encoder(row: Row) -> tuple[str, str]:
    """Which encoder a row is about; its probes are pieces of their own."""
    return _value(row.goal), str(row.goal.place.get("encoder_seed", row.goal.place.get("seed", "")))


def _column(row: Row) -> str:
    where = row["domain"] if row["colors"] == "normal" else f"{row['domain']} {row['colors']}"
    return f"{where}, {row['embedding']}, {READ.get(row['measure'], '')}"

"""One-factor trials of pre-training: diagnostics, probes and scores by the value of what was changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Table
from crptpro.experiments.report.diagnostics import diagnostics, group_of, groups_of, records_of
from crptpro.experiments.report.measurements import Row, rows_of
from crptpro.experiments.report.palette import in_order
from crptpro.experiments.report.reading import Asked, Wanted

READ = {"r2_position": "positions", "r2_velocity": "velocities"}


def study(asked: Asked) -> tuple[Block, ...]:
    """Report, for each factor and group, final diagnostics, curves and probes by value.

    A goal's place names its ``factor`` and ``value``, and its ``group`` if there are several.
    """
    probes, blocks = rows_of(asked, "probe")
    records = records_of(asked)
    factors = list(dict.fromkeys(_factor(goal) for goal in asked.finished))
    for number, factor in enumerate(factors):
        goals = [goal for goal in asked.finished if _factor(goal) == factor]
        for group in groups_of(goals):
            of = ", ".join(part for part in (factor, f"group {group}" * bool(group)) if part)
            of = f"{of[0].upper()}{of[1:]}. " if of else ""
            heading = factor or "variant"
            own = [
                (goal, rows) for goal, rows in records if (_factor(goal), group_of(goal)) == (factor, group)
            ]
            read = [row for row in probes if (_factor(row.goal), group_of(row.goal)) == (factor, group)]
            if own:
                blocks += diagnostics(own, _value, heading, f"{asked.name}-{number + 1}{group}", of)
            if read:
                blocks.append(_probes(read, heading, of))
    return tuple(blocks)


def _factor(goal: Wanted) -> str:
    return str(goal.place.get("factor", ""))


def _value(goal: Wanted) -> str:
    return str(goal.place.get("value", goal.label))


def _probes(rows: Sequence[Row], heading: str, of: str) -> Table:
    measured = [row for row in rows if not row["coordinate"] and row["measure"] in READ]
    columns = list(dict.fromkeys(_column(row) for row in measured))
    lines = []
    for label in in_order(_value(row.goal) for row in measured):
        line = [Cell(label)]
        for column in columns:
            own = [row for row in measured if _value(row.goal) == label and _column(row) == column]
            values = [value for row in own if (value := row.number("value")) is not None]
            spread = f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 else ""
            line.append(
                Cell(f"{np.mean(values):.3f}{spread}", f"n = {len(values)}") if values else Cell(ABSENT)
            )
        lines.append(tuple(line))
    caption = f"{of}State probe: R2 on held-out episodes, mean over encoders."
    return Table(caption, (heading, *columns), tuple(lines))


def _column(row: Row) -> str:
    where = row["domain"] if row["colors"] == "normal" else f"{row['domain']} {row['colors']}"
    return f"{where}, {row['embedding']}, {READ.get(row['measure'], '')}"

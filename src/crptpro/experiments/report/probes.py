"""State probes: what frozen features tell of positions and velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Table, cells
from crptpro.experiments.report.measurements import Row, rows_of
from crptpro.experiments.report.palette import in_order
from crptpro.experiments.report.reading import Asked

MEASURES = {
    "r2_position": ("R2 of positions", ".3f"),
    "r2_velocity": ("R2 of velocities", ".3f"),
    "effective_rank": ("Effective rank", ".1f"),
    "mean_cosine": ("Mean pairwise cosine", ".4f"),
}
"""Measure of a probe's table to what it is and how it is printed."""


def probes(asked: Asked) -> tuple[Block, ...]:
    """Report state probes: one table per measure and embedding, a column per domain and colours."""
    rows, blocks = rows_of(asked, "probe")
    means = [row for row in rows if not row["coordinate"]]
    for embedding in dict.fromkeys(row["embedding"] for row in means):
        for measure in MEASURES:
            part = [row for row in means if (row["embedding"], row["measure"]) == (embedding, measure)]
            if part:
                blocks.append(_table(part, measure, embedding))
    return tuple(blocks)


def _table(rows: Sequence[Row], measure: str, embedding: str) -> Table:
    name, spec = MEASURES[measure]
    columns = list(dict.fromkeys((row["domain"], row["colors"]) for row in sorted(rows, key=_order)))
    groups = {(row.goal.label, str(row.goal.place.get("group", ""))) for row in rows}
    labels = in_order(label for label, _ in sorted(groups))
    lines = []
    for label in labels:
        for group in sorted(group for other, group in groups if other == label):
            own = [r for r in rows if (r.goal.label, str(r.goal.place.get("group", ""))) == (label, group)]
            lines.append(cells(label, group or ABSENT, *(_cell(own, column, spec) for column in columns)))
    headings = [domain if colors == "normal" else f"{domain}, {colors}" for domain, colors in columns]
    what = "features of the frozen encoder" if embedding == "features" else f"embedding {embedding}"
    caption = f"{name}, {what}: mean over encoders (n), and whether their pre-training saw the domain."
    return Table(caption, ("encoder", "group", *headings), tuple(lines), labels=2)


def _cell(rows: Sequence[Row], column: tuple[str, str], spec: str) -> Cell:
    own = [row for row in rows if (row["domain"], row["colors"]) == column]
    values = [value for row in own if (value := row.number("value")) is not None]
    if not values:
        return Cell(ABSENT)
    spread = f" ± {np.std(values, ddof=1):{spec}}" if len(values) > 1 else ""
    seen = " or ".join(sorted({"seen" if row["seen"] == "yes" else "unseen" for row in own}))
    return Cell(f"{np.mean(values):{spec}}{spread}", f"{seen}, n = {len(values)}")


def _order(row: Row) -> tuple[bool, str]:
    return row["colors"] != "normal", row["domain"]

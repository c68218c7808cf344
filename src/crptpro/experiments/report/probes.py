"""State probes: what frozen features tell of positions and velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import (
    ABSENT,
    Block,
    Cell,
    Figure,
    Paragraph,
    Table,
    cells,
    numbered,
)
from crptpro.experiments.report.measurements import Row, rows_of
from crptpro.experiments.report.palette import in_order, styles
from crptpro.experiments.report.reading import Asked

MEASURES = {
    "r2_position": ("R2 of positions", ".3f"),
    "r2_velocity": ("R2 of velocities", ".3f"),
    "effective_rank": ("Effective rank (at most the number of observations)", ".1f"),
    "mean_cosine": ("Mean pairwise cosine", ".4f"),
}
"""Measure of a probe's table to what it is and how it is printed."""
DRAWN = ("r2_position", "r2_velocity")
"""Measures that the figure shows side by side."""

System = tuple[str, str]
"""An encoder's label and the group that it was pre-trained for, empty for none."""
Column = tuple[str, str]
"""A domain and its colours."""


def probes(asked: Asked) -> tuple[Block, ...]:
    """Report state probes: one table per measure and embedding, a column per domain and colours, and a figure."""
    rows, blocks = rows_of(asked, "probe")
    means = [row for row in rows if not row["coordinate"]]
    if means:
        blocks.append(held_out(rows))
    drawn = [row for row in means if row["embedding"] == "features" and row["measure"] in DRAWN]
    if drawn:
        blocks.append(_figure(f"{asked.name}-features", drawn))
    for embedding in dict.fromkeys(row["embedding"] for row in means):
        for measure in MEASURES:
            part = [row for row in means if (row["embedding"], row["measure"]) == (embedding, measure)]
            if part:
                blocks.append(_table(part, measure, embedding))
    return tuple(blocks)


def held_out(rows: Sequence[Row]) -> Paragraph:
    """Say what R2 was measured on, and from what it was held out."""
    samples, episodes = (_numbers(rows, column) for column in ("samples", "held_out_episodes"))
    counts = f": {samples} observations per probe, {episodes} episodes of them held out" if samples else ""
    return Paragraph(
        f"R2 is that of held-out episodes{counts}. A mean over coordinates counts a negative one as 0. Episodes are "
        "held out from the regression: an encoder that learned from a domain's random data may have seen these very "
        "observations, without their states; one that explored or is untrained has not, and of unseen domains none "
        "has.",
        "note",
    )


def _numbers(rows: Sequence[Row], column: str) -> str:
    known = {at for row in rows if (at := row.number(column)) is not None}
    return " or ".join(f"{at:,.0f}" for at in sorted(known))


def _figure(name: str, rows: Sequence[Row]) -> Figure:
    columns = _columns(rows)
    systems = _systems(rows)
    several = len({group for _, group in systems}) > 1
    names = {system: ", ".join(system) if several and system[1] else system[0] for system in systems}
    look = styles(names.values())
    panels = []
    for measure in DRAWN:
        dots = [
            drawing.Dots(
                name,
                look[name],
                [_mean([r for r in rows if r["measure"] == measure], system, column) for column in columns],
            )
            for system, name in names.items()
        ]
        panels.append((MEASURES[measure][0], dots))
    caption = (
        "What a linear model reads from the features of the frozen encoder: R2 on held-out episodes, mean over "
        f"coordinates and encoders ({numbered(_counts(rows, systems, columns))})."
    )
    return Figure(name, caption, drawing.dots([_heading(column) for column in columns], panels))


def _table(rows: Sequence[Row], measure: str, embedding: str) -> Table:
    name, spec = MEASURES[measure]
    columns, systems = _columns(rows), _systems(rows)
    counts = _counts(rows, systems, columns)
    lines = [
        cells(
            label,
            group or ABSENT,
            *(_cell(_own(rows, (label, group), column), spec, len(counts) > 1) for column in columns),
        )
        for label, group in systems
    ]
    what = "features of the frozen encoder" if embedding == "features" else f"embedding {embedding}"
    caption = f"{name}, {what}: mean over encoders ({numbered(counts)}), and whether their pre-training saw the domain."
    return Table(caption, ("encoder", "group", *map(_heading, columns)), tuple(lines), labels=2)


def _cell(own: Sequence[Row], spec: str, is_counted: bool) -> Cell:
    values = _values(own)
    if not values:
        return Cell(ABSENT)
    spread = f" ± {np.std(values, ddof=1):{spec}}" if len(values) > 1 else ""
    seen = " or ".join(sorted({"seen" if row["seen"] == "yes" else "unseen" for row in own}))
    count = f", n = {len(values)}" if is_counted else ""
    return Cell(f"{np.mean(values):{spec}}{spread}", f"{seen}{count}")


def _systems(rows: Sequence[Row]) -> list[System]:
    """Return encoders' labels and groups, in the order of tables."""
    found = {(row.goal.label, str(row.goal.place.get("group", ""))) for row in rows}
    labels = in_order(label for label, _ in sorted(found))
    return [(label, group) for label in labels for group in sorted(g for other, g in found if other == label)]


def _columns(rows: Sequence[Row]) -> list[Column]:
    """Return domains, each in its usual colours first."""
    found = {(row["domain"], row["colors"]) for row in rows}
    return sorted(found, key=lambda column: (column[0], column[1] != "normal", column[1]))


def _heading(column: Column) -> str:
    domain, colors = column
    return domain if colors == "normal" else f"{domain}, {colors.replace('_', ' ')}"


def _own(rows: Sequence[Row], system: System, column: Column) -> list[Row]:
    return [
        row
        for row in rows
        if (row["domain"], row["colors"]) == column
        and (row.goal.label, str(row.goal.place.get("group", ""))) == system
    ]


def _values(rows: Sequence[Row]) -> list[float]:
    return [value for row in rows if (value := row.number("value")) is not None]


def _mean(rows: Sequence[Row], system: System, column: Column) -> float | None:
    values = _values(_own(rows, system, column))
    return float(np.mean(values)) if values else None


def _counts(rows: Sequence[Row], systems: Sequence[System], columns: Sequence[Column]) -> set[int]:
    """Return how many encoders cells stand on, each number once; rows of one measure count an encoder once."""
    return {
        len({row.goal.piece.key for row in own if row.number("value") is not None})
        for system in systems
        for column in columns
        if (own := _own(rows, system, column))
    }

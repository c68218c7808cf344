"""What pre-training records of itself: comparative loss, cosine, prototypes in use; stability and studies."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Paragraph, Table, cells
from crptpro.experiments.report.measurements import Row, rows_of
from crptpro.experiments.report.palette import in_order, styles
from crptpro.experiments.report.reading import Asked, Wanted, number, read_table

PRETRAINED = ("encoder", "explored", "finetuned")
"""Kinds of pieces that leave ``pretrain.csv``."""
NAMES = {
    "comp": "comparative loss [nats]",
    "embedding_cosine": "mean pairwise cosine",
    "assignment_entropy_frac": "assignment entropy / ln M",
    "prototypes_in_use": "prototypes in use",
    "prototype_ane": "ANE of prototypes",
}
"""Column of ``pretrain.csv`` to what it is."""
Record = tuple[Wanted, list[dict[str, str]]]
Naming = Callable[[Wanted], str]

WINDOW = 5
"""Rows at the end of a record that a final value averages over."""


def stability(asked: Asked) -> tuple[Block, ...]:
    """Comparative losses along training, random data against data of explorers (the paper's stability figure)."""
    own = _records(asked)
    if not own:
        return ()
    caption = "Comparative loss and mean cosine along pre-training, a line per encoder (n in the legend)."
    panels = [_panel(own, column, lambda goal: goal.label) for column in ("comp", "embedding_cosine")]
    return (
        Figure(f"{asked.name}-loss", caption, drawing.lines([p for p in panels if p.lines])),
        _finals(own, lambda goal: goal.label, "encoder"),
        Paragraph(
            "A comparative loss at ln M, or a cosine near 1, has learned nothing yet. The last "
            f"{WINDOW} rows of a record are averaged; the wobble is their standard deviation.",
            "note",
        ),
    )


def study(asked: Asked) -> tuple[Block, ...]:
    """One-factor trials: for each factor final diagnostics and probes by value, and curves."""
    probe_rows, blocks = rows_of(asked, "probe")
    records = _records(asked)
    factors = dict.fromkeys(str(goal.place.get("factor", "")) for goal in asked.finished)
    for factor in factors:
        of = f"{factor}: " if factor else ""
        own = [(goal, rows) for goal, rows in records if str(goal.place.get("factor", "")) == factor]
        read = [row for row in probe_rows if str(row.goal.place.get("factor", "")) == factor]
        if own:
            blocks.append(_finals(own, _value, factor or "variant"))
            panels = [
                _panel(own, column, _value)
                for column in ("comp", "embedding_cosine", "assignment_entropy_frac")
            ]
            caption = f"{of}diagnostics along pre-training, a line per encoder (n in the legend)."
            picture = drawing.lines([panel for panel in panels if panel.lines])
            blocks.append(Figure(f"{asked.name}-{factor or 'all'}", caption, picture))
        if read:
            blocks.append(_probes(read, factor or "variant"))
    return tuple(blocks)


def _records(asked: Asked) -> list[Record]:
    found = []
    for goal in asked.finished:
        path = goal.piece.directory / "pretrain.csv"
        if goal.piece.kind in PRETRAINED and path.exists():
            found.append((goal, read_table(path)))
    return found


def _value(goal: Wanted) -> str:
    return str(goal.place.get("value", goal.label))


def _panel(records: Sequence[Record], column: str, name: Naming) -> drawing.Panel:
    labels = in_order(name(goal) for goal, _ in records)
    look = styles(labels)
    curves, marks = [], {}
    for goal, rows in records:
        known = [
            (x, y)
            for r in rows
            if (x := number(r, "updates")) is not None and (y := number(r, column)) is not None
        ]
        if not known:
            continue
        label = name(goal)
        count = sum(name(other) == label for other, _ in records)
        curves.append(
            drawing.Line(f"{label} (n = {count})", look[label], [x for x, _ in known], [y for _, y in known])
        )
        if column == "comp" and (uniform := number(rows[-1], "ln_num_prototypes")):
            marks[f"ln M = {uniform:.3f}"] = uniform
    return drawing.Panel("", "encoder updates", NAMES[column], curves, marks)


def _finals(records: Sequence[Record], name: Naming, heading: str) -> Table:
    lines = []
    for label in in_order(name(goal) for goal, _ in records):
        own = [rows for goal, rows in records if name(goal) == label]
        updates = " or ".join(sorted({f"{number(rows[-1], 'updates') or 0:,.0f}" for rows in own if rows}))
        lines.append(cells(label, str(len(own)), updates, *(_final(own, column) for column in NAMES)))
    caption = f"Diagnostics at the end of pre-training, mean of the last {WINDOW} rows, then over encoders."
    return Table(caption, (heading, "encoders", "updates", *NAMES.values()), tuple(lines))


def _final(records: Sequence[list[dict[str, str]]], column: str) -> Cell:
    ends = [[v for row in rows if (v := number(row, column)) is not None][-WINDOW:] for rows in records]
    ends = [values for values in ends if values]
    if not ends:
        return Cell(ABSENT)
    wobble = np.mean([np.std(values) for values in ends])
    return Cell(f"{np.mean([np.mean(values) for values in ends]):.4g}", f"wobble {wobble:.2g}")


def _probes(rows: Sequence[Row], heading: str) -> Table:
    measured = [r for r in rows if not r["coordinate"] and r["measure"] in ("r2_position", "r2_velocity")]
    columns = list(dict.fromkeys((r["domain"], r["colors"], r["embedding"], r["measure"]) for r in measured))
    lines = []
    for label in in_order(_value(row.goal) for row in measured):
        line = [Cell(label)]
        for column in columns:
            values = [
                value
                for r in measured
                if _value(r.goal) == label and (r["domain"], r["colors"], r["embedding"], r["measure"]) == column
                and (value := r.number("value")) is not None
            ]  # fmt: skip
            spread = f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 else ""
            line.append(
                Cell(f"{np.mean(values):.3f}{spread}", f"n = {len(values)}") if values else Cell(ABSENT)
            )
        lines.append(tuple(line))
    names = {"r2_position": "positions", "r2_velocity": "velocities"}
    headings = []
    for domain, colors, embedding, measure in columns:
        where = domain if colors == "normal" else f"{domain} {colors}"
        headings.append(f"{where}, {embedding}, {names[measure]}")
    return Table(
        "State probe: R2 on held-out episodes, mean over encoders.", (heading, *headings), tuple(lines)
    )

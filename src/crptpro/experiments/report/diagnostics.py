"""What pre-training records of itself: comparative loss, cosine, assignments, prototypes in use."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Paragraph, Table, cells, sentence
from crptpro.experiments.report.palette import in_order, styles
from crptpro.experiments.report.reading import Asked, Wanted, number
from crptpro.experiments.row_files import read_rows

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
DRAWN = ("comp", "embedding_cosine", "assignment_entropy_frac")
WINDOW = 5
"""Rows at the end of a record that a final value averages over."""
PLATEAU = 0.99
"""Share of ln M: a comparative loss that stays below has left the plateau, where all prototypes look alike."""

Record = tuple[Wanted, list[dict[str, str]]]
Naming = Callable[[Wanted], str]


def stability(asked: Asked) -> tuple[Block, ...]:
    """Comparative losses along training, random data against data of explorers (the paper's stability figure)."""
    found = records_of(asked)
    blocks: list[Block] = []
    for group in groups_of([goal for goal, _ in found]):
        own = [(goal, rows) for goal, rows in found if group_of(goal) == group]
        blocks += diagnostics(
            own, lambda goal: goal.label, "encoder", f"{asked.name}{_dashed(group)}", _of(group)
        )
    if blocks:
        text = (
            "A comparative loss at ln M, or a cosine near 1, has learned nothing yet. Final values average the last "
            f"{WINDOW} rows of a record; the wobble is their standard deviation."
        )
        blocks.append(Paragraph(text, "note"))
    return tuple(blocks)


def records_of(asked: Asked) -> list[Record]:
    """Read the pre-training record of every finished encoder of an experiment.

    Raises:
        RecordError: one cannot be read.
    """
    found = []
    for goal in asked.finished:
        path = goal.piece.directory / "pretrain.csv"
        if goal.piece.kind in PRETRAINED and path.exists():
            found.append((goal, read_rows(path)))
    return found


def group_of(goal: Wanted) -> str:
    """Return the group that a goal belongs to; empty if its place names none."""
    return str(goal.place.get("group", ""))


def groups_of(goals: Sequence[Wanted]) -> list[str]:
    """Return the groups of goals."""
    return sorted({group_of(goal) for goal in goals})


def left_plateau(rows: Sequence[dict[str, str]]) -> float | None:
    """Return after how many updates a comparative loss has left its plateau for good.

    Args:
        rows: of ``pretrain.csv``, in order.

    Returns:
        Encoder updates at the first row from which the loss stays below :data:`PLATEAU` of ln M; ``None`` if the record
        ends on the plateau, or there is no such loss.
    """
    left = None
    for row in rows:
        loss, uniform = number(row, "comp"), number(row, "ln_num_prototypes")
        if loss is None or uniform is None:
            continue
        if loss >= PLATEAU * uniform:
            left = None
        elif left is None:
            left = number(row, "updates")
    return left


def diagnostics(records: Sequence[Record], name: Naming, heading: str, figure: str, of: str) -> list[Block]:
    """Show final values and curves of encoders.

    Args:
        records: of encoders that compare.
        name: label of an encoder; those with one label are averaged in the table.
        heading: what the labels are.
        figure: name of the figure.
        of: what distinguishes these records, for captions; may be empty.
    """
    panels = [panel for column in DRAWN if (panel := _panel(records, column, name)).lines]
    blocks: list[Block] = []
    if panels:
        caption = f"{of}diagnostics along pre-training, a line per encoder (n in the legend)."
        blocks.append(Figure(figure, sentence(caption), drawing.lines(panels)))
    return [*blocks, _finals(records, name, heading, of)]


def _panel(records: Sequence[Record], column: str, name: Naming) -> drawing.Panel:
    labels = in_order(name(goal) for goal, _ in records)
    look = styles(labels)
    curves, marks = [], {}
    for goal, rows in records:
        points = [(number(row, "updates"), number(row, column)) for row in rows]
        known = [(x, y) for x, y in points if x is not None and y is not None]
        if not known:
            continue
        label = name(goal)
        count = sum(name(other) == label for other, _ in records)
        x, y = zip(*known)
        curves.append(drawing.Line(f"{label} (n = {count})", look[label], x, y))
        if column == "comp" and (uniform := number(rows[-1], "ln_num_prototypes")):
            marks[f"ln M = {uniform:.3f}"] = uniform
    return drawing.Panel("", "encoder updates", NAMES[column], curves, marks)


def _finals(records: Sequence[Record], name: Naming, heading: str, of: str) -> Table:
    lines = []
    for label in in_order(name(goal) for goal, _ in records):
        own = [rows for goal, rows in records if name(goal) == label]
        reached = {number(rows[-1], "updates") or 0 for rows in own if rows}
        updates = " or ".join(f"{at:,.0f}" for at in sorted(reached))
        finals = (_final(own, column) for column in NAMES)
        lines.append(cells(label, str(len(own)), updates, plateau(own), *finals))
    caption = (
        f"{of}diagnostics at the end of pre-training, mean of the last {WINDOW} rows, then over encoders. The plateau "
        f"is left where the comparative loss stays below {PLATEAU:.0%} of ln M from then on."
    )
    columns = (heading, "encoders", "updates", "left the plateau at", *NAMES.values())
    return Table(sentence(caption), columns, tuple(lines))


def plateau(records: Sequence[list[dict[str, str]]]) -> Cell:
    """Say when encoders left their plateau, mean and range, and how many did.

    Args:
        records: rows of ``pretrain.csv`` of each encoder.
    """
    left = [left_plateau(rows) for rows in records if rows and number(rows[-1], "ln_num_prototypes")]
    known = [updates for updates in left if updates is not None]
    if not left:
        return Cell(ABSENT)
    if not known:
        return Cell("not left")
    among = "" if len(known) == len(left) else f"{len(known)} of {len(left)} encoders"
    spread = f"{min(known):,.0f} to {max(known):,.0f}" if min(known) < max(known) else ""
    return Cell(f"{np.mean(known):,.0f}", "; ".join(part for part in (among, spread) if part))


def _final(records: Sequence[list[dict[str, str]]], column: str) -> Cell:
    ends = [[v for row in rows if (v := number(row, column)) is not None][-WINDOW:] for rows in records]
    ends = [values for values in ends if values]
    if not ends:
        return Cell(ABSENT)
    wobble = np.mean([np.std(values) for values in ends])
    return Cell(f"{np.mean([np.mean(values) for values in ends]):.4g}", f"wobble {wobble:.2g}")


def _dashed(group: str) -> str:
    return f"-{group}" if group else ""


def _of(group: str) -> str:
    return f"group {group}: " if group else ""

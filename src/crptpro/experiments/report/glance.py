"""What every value of a study changed against the usual one: all factors in one table, along training, and drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Paragraph, Table, cells, counted
from crptpro.experiments.report.diagnostics import Record, plateau
from crptpro.experiments.report.palette import styles
from crptpro.experiments.report.trials import CONTROL, Reading, Trial, at_end, changes, trial_of

POSITIONS, VELOCITIES = "r2_position", "r2_velocity"
GLANCE = {
    "velocities, features": (VELOCITIES, "features"),
    "velocities, z": (VELOCITIES, "z"),
    "positions, features": (POSITIONS, "features"),
}
"""Columns of the first table: name to measure and embedding."""


def glance(found: Sequence[Reading], records: Sequence[Record], name: str) -> list[Block]:
    """Show all factors beside each other; nothing where no value is the usual one.

    Args:
        found: what was read of every encoder.
        records: of their training.
        name: for the name of the figure.
    """
    trials = [trial for trial in dict.fromkeys(r.trial for r in found) if trial.factor != CONTROL]
    if not any(trial.is_usual for trial in trials):
        return []
    factors = list(dict.fromkeys(trial.factor for trial in trials))
    trials.sort(key=lambda trial: (factors.index(trial.factor), trial.group))
    controls = sorted({r.trial for r in found if r.trial.factor == CONTROL}, key=lambda trial: trial.group)
    lines = [_line(found, records, trial) for trial in (*trials, *controls)]
    caption = (
        "All values at a glance: R2 at the end on held-out episodes, mean over coordinates, domains and encoders. "
        "Below it the mean change against the usual value's encoders of the same seeds."
    )
    columns = ("factor", "value", "group", "encoders", "updates", "left the plateau at", *GLANCE)
    blocks: list[Block] = [Table(caption, columns, tuple(lines), labels=3)]
    changed = [trial for trial in trials if not trial.is_usual]
    rows = list(dict.fromkeys((trial.factor, trial.value) for trial in changed))
    places = sorted({r.updates for r in found if r.trial in changed})
    for embedding in ("features", "z"):
        table = _changes(found, changed, rows, places, embedding)
        blocks += [table] if table.rows and len(places) > 1 else []
    ends = at_end(found)
    if any(sum(reading.trial == trial for reading in ends) == 1 for trial in trials):
        text = (
            "A change that stands on one pair of encoders has no range below it: what another seed alone would "
            "change is to be seen where a value has several."
        )
        blocks.append(Paragraph(text, "note"))
    return [*blocks, *_drawn(found, changed, rows, name)]


def _line(found: Sequence[Reading], records: Sequence[Record], trial: Trial) -> tuple[Cell, ...]:
    ends = [reading for reading in at_end(found) if reading.trial == trial]
    updates = " or ".join(f"{at:,}" for at in sorted({reading.updates for reading in ends}))
    numbers = []
    for measure in GLANCE.values():
        values = [reading.values[measure] for reading in ends if measure in reading.values]
        differences = [] if trial.is_usual else changes(found, [trial], None, measure)
        mean = f"{np.mean(values):.3f}" if values else ABSENT
        numbers.append(Cell(mean, f"{np.mean(differences):+.3f}" if differences else ""))
    left = plateau([rows for goal, rows in records if trial_of(goal) == trial])
    name = trial.factor if trial.factor != CONTROL else ""
    value = f"{trial.value} (usual)" if trial.is_usual else trial.value
    count = str(len({reading.seed for reading in ends}))
    return cells(words(name) or ABSENT, value, trial.group or ABSENT, count, updates, left, *numbers)


def _changes(
    found: Sequence[Reading],
    trials: Sequence[Trial],
    rows: Sequence[tuple[str, str]],
    places: Sequence[int],
    embedding: str,
) -> Table:
    """Differences along training, over all groups."""
    lines = []
    for factor, value in rows:
        own = [trial for trial in trials if (trial.factor, trial.value) == (factor, value)]
        parts = [changes(found, own, at, (VELOCITIES, embedding)) for at in places]
        if any(parts):
            numbers = [Cell(f"{np.mean(p):+.3f}", _spread(p)) if p else Cell(ABSENT) for p in parts]
            pairs = str(max(len(part) for part in parts))
            lines.append(cells(words(factor) or ABSENT, value, pairs, *numbers))
    caption = (
        f"Change of the R2 of velocities from {embedding} against the usual value, by encoder updates: mean over pairs "
        "of encoders of one group and seed (least to largest), each a mean over domains."
    )
    columns = ("factor", "value", "pairs", *(f"{at:,}" for at in places))
    return Table(caption, columns, tuple(lines), labels=2)


def _drawn(
    found: Sequence[Reading], trials: Sequence[Trial], rows: Sequence[tuple[str, str]], name: str
) -> list[Block]:
    """The same as marks: after updates that all encoders have been probed at, and at their end."""
    own = {row: [trial for trial in trials if (trial.factor, trial.value) == row] for row in rows}
    probed = [{r.updates for r in found if r.trial in of} for of in own.values()]
    shared = sorted(set.intersection(*probed)) if probed else []
    points: dict[str, int | None] = {f"after {at:,} updates": at for at in shared}
    if any(max(places) not in shared[-1:] for places in probed):
        points["at the end"] = None
    look = styles(points)
    panels = []
    for title, measure in GLANCE.items():
        marks = []
        for label, at in points.items():
            differences = [changes(found, own[row], at, measure) for row in rows]
            marks.append(
                drawing.Dots(label, look[label], [float(np.mean(d)) if d else None for d in differences])
            )
        panels.append((f"change of R2: {title}", marks))
    if all(value is None for _, marks in panels for mark in marks for value in mark.values):
        return []
    caption = (
        "What each value changed against the usual one: mean over pairs of encoders of one group and seed."
    )
    first, places = next(iter(GLANCE.values())), points.values()
    pairs = {row: max((len(changes(found, own[row], at, first)) for at in places), default=0) for row in rows}
    names = [f"{words(row[0])} {row[1]}".strip() + f" ({counted(pairs[row], 'pair')})" for row in rows]
    return [Figure(f"{name}-changes", caption, drawing.dots(names, panels, mark=0.0))]


def _spread(differences: Sequence[float]) -> str:
    return f"{min(differences):+.3f} to {max(differences):+.3f}" if len(differences) > 1 else ""


def words(name: str) -> str:
    """Return a factor's name as words."""
    return name.replace("_", " ")

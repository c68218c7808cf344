"""One-factor trials of pre-training: what was gained at a glance, then diagnostics and probes of each factor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import (
    ABSENT,
    Block,
    Cell,
    Figure,
    Heading,
    Table,
    sentence,
)
from crptpro.experiments.report.diagnostics import diagnostics, records_of
from crptpro.experiments.report.each_encoder import each_encoder
from crptpro.experiments.report.glance import POSITIONS, VELOCITIES, glance, words
from crptpro.experiments.report.measurements import Row, rows_of
from crptpro.experiments.report.palette import in_order, styles
from crptpro.experiments.report.probes import held_out
from crptpro.experiments.report.reading import Asked, Wanted
from crptpro.experiments.report.trials import (
    CONTROL,
    last_updates,
    readings,
    seed_of,
    trial_of,
    updates_of,
)


def study(asked: Asked) -> tuple[Block, ...]:
    """Report what each value changed; then, for each factor and group, final diagnostics, curves and probes.

    A goal's place names its ``factor``, ``value`` and ``usual`` value, its ``group``, and ``updates`` if an encoder was
    probed along its training.
    """
    probes, blocks = rows_of(asked, "probe")
    probes = [row for row in probes if not row["coordinate"] and row["measure"] in (POSITIONS, VELOCITIES)]
    records = records_of(asked)
    ends = last_updates(goal for goal in asked.goals if goal.piece.kind == "probe")
    found = readings(probes)
    if probes:
        blocks.append(held_out(probes))
    blocks += glance(found, records, asked.name)
    trials = dict.fromkeys(trial_of(goal) for goal in asked.finished if goal.piece.kind != "run")
    parts = dict.fromkeys((trial.factor, trial.group) for trial in trials)
    for factor, group in parts:
        if factor == CONTROL and any(other != CONTROL for other, _ in parts):
            continue
        of = ", ".join(part for part in (words(factor), f"group {group}" * bool(group)) if part)
        if of:
            blocks.append(Heading(sentence(of)))
            of = f"{of}: "
        heading = words(factor) or "variant"
        name = f"{asked.name}-{list(dict.fromkeys(f for f, _ in parts)).index(factor) + 1}{group}"
        own = [record for record in records if _stands(record[0], (factor,), group)]
        read = [row for row in probes if _stands(row.goal, (factor, CONTROL), group)]
        if own:
            blocks += diagnostics(own, _value, heading, name, of)
        if read:
            ended = [
                row for row in read if updates_of(row.goal) == ends[trial_of(row.goal), seed_of(row.goal)]
            ]
            embeddings = dict.fromkeys(row["embedding"] for row in ended)
            blocks += [_probes(ended, embedding, heading, of) for embedding in embeddings]
            mine = [r for r in found if r.trial.factor in (factor, CONTROL) and r.trial.group == group]
            blocks += each_encoder(mine, own, heading, of)
            blocks += _along(read, f"{name}-probe", of)
    return tuple(blocks)


def _probes(rows: Sequence[Row], embedding: str, heading: str, of: str) -> Table:
    """What is read from an embedding of encoders that are at their end, a column per domain."""
    ends = [row for row in rows if row["embedding"] == embedding]
    ends.sort(key=lambda row: trial_of(row.goal).factor == CONTROL)
    columns = list(dict.fromkeys(_column(row) for row in ends))
    lines = []
    for label in in_order(_value(row.goal) for row in ends):
        line = [Cell(label)]
        for column in columns:
            own = [row for row in ends if (_value(row.goal), _column(row)) == (label, column)]
            line.append(_both(own))
        lines.append(tuple(line))
    caption = (
        f"{of}positions / velocities read from {embedding} at the end, held-out R2, mean over encoders (n)."
    )
    return Table(sentence(caption), (heading, *columns), tuple(lines))


def _both(rows: Sequence[Row]) -> Cell:
    parts = []
    for measure in (POSITIONS, VELOCITIES):
        values = [v for row in rows if row["measure"] == measure and (v := row.number("value")) is not None]
        spread = f"{np.std(values, ddof=1):.3f}" if len(values) > 1 else ABSENT
        parts.append((f"{np.mean(values):.3f}", len(values), spread) if values else (ABSENT, 0, ABSENT))
    count = max(count for _, count, _ in parts)
    if not count:
        return Cell(ABSENT)
    spread = f"± {parts[0][2]} / {parts[1][2]}, " if count > 1 else ""
    return Cell(" / ".join(text for text, _, _ in parts), f"{spread}n = {count}")


def _along(rows: Sequence[Row], name: str, of: str) -> list[Block]:
    """R2 of velocities along training, from features; nothing where encoders were probed at their end alone."""
    rows = [row for row in rows if row["measure"] == VELOCITIES and row["embedding"] == "features"]
    trained = [row for row in rows if trial_of(row.goal).factor != CONTROL]
    if len({updates_of(row.goal) for row in trained}) < 2:
        return []
    labels = in_order(_value(row.goal) for row in trained)
    look, panels = styles(labels), []
    for column in dict.fromkeys(_column(row) for row in trained):
        here = [row for row in trained if _column(row) == column]
        curves = []
        for label in labels:
            own = [row for row in here if _value(row.goal) == label]
            places = sorted({updates_of(row.goal) for row in own})
            read = [[r.number("value") for r in own if updates_of(r.goal) == at] for at in places]
            means = [np.mean([np.nan if value is None else value for value in part]) for part in read]
            encoders = len({_encoder(row) for row in own})
            curves.append(drawing.Line(f"{label} (n = {encoders})", look[label], places, means))
        controls = [row for row in rows if trial_of(row.goal).factor == CONTROL and _column(row) == column]
        known = [value for row in controls if (value := row.number("value")) is not None]
        marks = {"untrained": float(np.mean(known))} if known else {}
        panels.append(drawing.Panel(column, "encoder updates", "R2 of velocities", curves, marks))
    caption = f"{of}state probe of the features along training, mean over encoders (n in the legend)."
    return [Figure(name, sentence(caption), drawing.lines(panels, columns=2))]


def _stands(goal: Wanted, factors: Sequence[str], group: str) -> bool:
    trial = trial_of(goal)
    return trial.factor in factors and trial.group == group


def _value(goal: Wanted) -> str:
    return trial_of(goal).value


def _encoder(row: Row) -> tuple[str, str]:
    """Which encoder a row is about; its probes are pieces of their own."""
    return _value(row.goal), seed_of(row.goal)


def _column(row: Row) -> str:
    return row["domain"] if row["colors"] == "normal" else f"{row['domain']} {row['colors']}"

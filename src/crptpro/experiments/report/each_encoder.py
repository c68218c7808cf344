"""What each encoder of a study was read to know along its training: the numbers that means and changes are made of."""

from __future__ import annotations

from collections.abc import Sequence

from crptpro.experiments.report.blocks import ABSENT, Cell, Table, cells, sentence
from crptpro.experiments.report.diagnostics import Record, plateau
from crptpro.experiments.report.glance import VELOCITIES
from crptpro.experiments.report.palette import in_order
from crptpro.experiments.report.trials import CONTROL, Reading, seed_of, trial_of


def each_encoder(found: Sequence[Reading], records: Sequence[Record], heading: str, of: str) -> list[Table]:
    """Show R2 of velocities after each number of updates, a line per encoder; nothing where all were probed once.

    Args:
        found: readings of one factor and group, with those of its untrained encoders.
        records: of the encoders' training.
        heading: what is varied.
        of: what precedes captions.
    """
    trained = [reading for reading in found if reading.trial.factor != CONTROL]
    places = sorted({reading.updates for reading in trained})
    if len(places) < 2:
        return []
    values = in_order(reading.trial.value for reading in trained)
    encoders = sorted(
        dict.fromkeys((r.trial.value, r.seed) for r in trained), key=lambda e: (values.index(e[0]), e[1])
    )
    tables = []
    for embedding in ("features", "z"):
        read = {(r.trial.value, r.seed, r.updates): r.values.get((VELOCITIES, embedding)) for r in trained}
        if all(value is None for value in read.values()):
            continue
        lines = []
        for value, seed in encoders:
            numbers = [_number(read.get((value, seed, at))) for at in places]
            own = [rows for goal, rows in records if (trial_of(goal).value, seed_of(goal)) == (value, seed)]
            lines.append(cells(value, seed, plateau(own), *numbers))
        for control in (reading for reading in found if reading.trial.factor == CONTROL):
            number = _number(control.values.get((VELOCITIES, embedding)))
            if number.text != ABSENT:
                # Of no updates, it stands beside every number of them.
                seed = control.seed or ABSENT
                lines.append(cells(control.trial.value, seed, ABSENT, *[number] * len(places)))
        caption = (
            f"{of}velocities read from {embedding} of each encoder after so many updates, held-out R2, mean over "
            "coordinates and domains."
        )
        columns = (heading, "encoder seed", "left the plateau at", *(f"{at:,}" for at in places))
        tables.append(Table(sentence(caption), columns, tuple(lines), labels=2))
    return tables


def _number(value: float | None) -> Cell:
    return Cell(ABSENT if value is None else f"{value:.3f}")

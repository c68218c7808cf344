"""What pre-training costs: hours and encoder updates by number of domains."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crptpro.cards import read_json
from crptpro.errors import CRPTproError, RecordError
from crptpro.experiments.measurements import TimingPiece
from crptpro.experiments.pieces import piece_from_json
from crptpro.experiments.published import EFFICIENCY
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Paragraph, Table, cells
from crptpro.experiments.report.machines import Machines
from crptpro.experiments.report.measurements import Row, mean_of, rows_of
from crptpro.experiments.report.palette import in_order
from crptpro.experiments.report.reading import Asked, Made, machine
from crptpro.experiments.store import DONE

PAPER = {entry.method: entry for entry in EFFICIENCY}
Timings = Mapping[tuple[str, int], Sequence[Row]]


def efficiency(asked: Asked) -> tuple[Block, ...]:
    """Hours and encoder updates of pre-training, by number of domains, beside the paper's on a P100."""
    rows, blocks = rows_of(asked, "timing")
    by_place: dict[str, list[Row]] = {}
    for row in rows:
        threads = f"{row['threads'] or '?'} thread{'s' * (row['threads'] != '1')}"
        where = f"{row['device'] or 'device not recorded'}, {threads}"
        by_place.setdefault(where, []).append(row)
    for where, part in sorted(by_place.items()):
        name = (
            asked.name
            if len(by_place) == 1
            else f"{asked.name}-{re.sub(r'[^a-z0-9]+', '-', where).strip('-')}"
        )
        blocks += _timed_on(where, part, name)
    return tuple(blocks)


def _timed_on(where: str, rows: Sequence[Row], name: str) -> list[Block]:
    found: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        found.setdefault((row["method"], int(row.number("domains") or 0)), []).append(row)
    methods, counts = in_order(method for method, _ in found), sorted({count for _, count in found})
    machines = Machines()
    made_on = {
        (method, count): machines.numbers_of(_machines(found[method, count]))
        for method in methods
        for count in counts
        if (method, count) in found
    }
    which = f". {machines.text()}" if machines.differ else " (hardware below)."
    numbered = made_on if machines.differ else {}
    text = (
        f"Timed on {where}{which} Hours are those of pre-training proper: environments that explore are part of it, "
        "the collection of random datasets, which is done once for all, has its own column: what it had taken when "
        "this was timed. Hours of the paper's budget follow updates with the paper's batches and decisions, which "
        "were timed for themselves."
    )
    return [
        _table(found, methods, counts, where, numbered),
        *_figures(name, found, methods, counts, numbered),
        Paragraph(text, "note"),
    ]


def _table(
    found: Timings,
    methods: Sequence[str],
    counts: Sequence[int],
    where: str,
    made_on: Mapping[tuple[str, int], str],
) -> Table:
    lines = []
    for method in methods:
        for count in counts:
            if not (own := found.get((method, count))):
                continue
            hours, updates = _paper(method, count)
            lines.append(
                cells(
                    method,
                    str(count),
                    Cell(mean_of(own, "seconds_per_update", 1, ".3g"), f"n = {len(own)}"),
                    mean_of(own, "seconds_per_decision", 1, ".3g"),
                    mean_of(own, "budget_updates", 1, ",.0f"),
                    mean_of(own, "projected_hours", 1, ".3g"),
                    mean_of(own, "collection_seconds", 1 / 3600, ".3g"),
                    Cell(
                        mean_of(own, "paper_updates", 1, ",.0f"),
                        published="" if updates is None else f"{updates:,}",
                    ),
                    Cell(
                        mean_of(own, "paper_projected_hours", 1, ".3g"),
                        published="" if hours is None else f"{hours:g}",
                    ),
                    *([made_on[method, count]] if made_on else []),
                )
            )
    columns = (
        "method", "domains", "s per encoder update", "s per decision", "encoder updates at this scale",
        "hours at this scale", "hours of collection", "encoder updates, paper's budget", "hours, paper's budget",
        *(["made on"] if made_on else []),
    )  # fmt: skip
    caption = (
        f"Pre-training by number of domains on {where}: some updates timed here (n timings), projected to whole "
        "budgets; the paper's hours are those of an NVIDIA Tesla P100."
    )
    return Table(caption, columns, tuple(lines), labels=2)


def _figures(
    name: str,
    found: Timings,
    methods: Sequence[str],
    counts: Sequence[int],
    made_on: Mapping[tuple[str, int], str],
) -> list[Block]:
    most = max(counts)
    timings = sum(len(own) for own in found.values())
    hours: dict[str, list[float | None]] = {
        f"projected here, {_domains(most)}": [
            _mean(found, m, most, "paper_projected_hours") for m in methods
        ],
        f"paper on a P100, {_domains(most)}": [_paper(m, most)[0] for m in methods],
    }
    updates = {
        _domains(count): [_mean(found, m, count, "paper_updates") for m in methods] for count in counts
    }
    caption = f"Hours of pre-training with the paper's budget for {_domains(most)}; {timings} timings of all counts."
    names = list(methods)
    if made_on:
        caption += " In brackets the machine, as numbered below: hours compare only within one."
        names = [f"{m} [{made_on.get((m, most), ABSENT)}]" for m in methods]
    was_timed = any(hour is not None for hour in hours[f"projected here, {_domains(most)}"])
    return [
        *([Figure(f"{name}-hours", caption, drawing.bars(names, hours, "hours"))] if was_timed else []),
        Figure(
            f"{name}-updates",
            "Encoder updates of the paper's budget by number of domains.",
            drawing.bars(methods, updates, "encoder updates"),
        ),
    ]


def _machines(rows: Sequence[Row]) -> list[str]:
    """Name the machines of timings, and of the timings that one adds up, which others may have made."""
    return [
        machine(done.get("hardware") or {})
        for piece in {row.goal.piece.key: row.goal.piece for row in rows}.values()
        for done in [piece.done or {}, *_parts_done(piece)]
    ]


def _parts_done(piece: Made) -> list[dict[str, Any]]:
    """Read what is recorded of the parts of a timing that adds up several."""
    try:
        described = piece_from_json(dict(piece.description))
    except CRPTproError:
        return []
    if not isinstance(described, TimingPiece) or len(described.encoders) < 2:
        return []
    found = []
    for part in described.parts:
        with contextlib.suppress(RecordError):
            found.append(read_json(piece.directory.parent / part.key / DONE, error=RecordError))
    return found


def _paper(method: str, count: int) -> tuple[float | None, int | None]:
    if method not in PAPER or count not in (1, 2, 3):
        return None, None
    return PAPER[method].hours[count - 1], PAPER[method].encoder_updates[count - 1]


def _mean(found: Timings, method: str, count: int, column: str) -> float | None:
    values = [value for row in found.get((method, count), ()) if (value := row.number(column)) is not None]
    return float(np.mean(values)) if values else None


def _domains(count: int) -> str:
    return f"{count} domain" if count == 1 else f"{count} domains"

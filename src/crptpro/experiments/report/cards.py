"""The card of every piece, closed until it is opened: what determines it, what made it, how long it took."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from crptpro.cards import read_json
from crptpro.data.incoming import dataset_path
from crptpro.errors import CRPTproError, RecordError
from crptpro.experiments.durations import duration
from crptpro.experiments.pieces import piece_from_json
from crptpro.experiments.records import Run
from crptpro.experiments.report.blocks import Block, Cell, Fold, Table, cells, counted, facts
from crptpro.experiments.report.reading import Made

LENGTHY = {"versions", "hardware", "modules", "crc32", "layout", "tensors", "records", "git_revision"}
"""Entries of cards that a page has elsewhere, or that tell a reader nothing."""
LONGEST = 160
"""Characters of a value that is shown."""


def anchor_of(key: str) -> str:
    """Return the anchor of a piece's card."""
    return f"piece-{key}"


def piece_cards(pieces: Mapping[str, Made]) -> tuple[Block, ...]:
    """Return one closed card per piece, by kind.

    Args:
        pieces: key to piece.
    """
    by_kind: dict[str, list[Made]] = {}
    for piece in pieces.values():
        by_kind.setdefault(piece.kind, []).append(piece)
    return tuple(
        Fold(f"{kind}: {counted(len(own), 'piece')}", tuple(_card(piece, pieces) for piece in own))
        for kind, own in by_kind.items()
    )


def run_cards(runs: Iterable[Run]) -> tuple[Block, ...]:
    """Return one closed card per run of a directory that is no reproduction."""
    found = []
    for run in runs:
        values = {"directory": str(run.directory), "encoder": run.encoder or "its own, or not recorded"}
        values |= dict(_flat(run.config.get("config", {})))
        title = f"{run.method} on {run.task}, seed {run.seed}"
        found.append(Fold(title, (facts("Settings", values),)))
    return tuple(found)


def _card(piece: Made, pieces: Mapping[str, Made]) -> Fold:
    rows = [cells("state", piece.state)]
    if piece.done is not None:
        if piece.seconds is not None:
            attempts = piece.done.get("attempts", 1)
            rows.append(cells(f"wall clock, {counted(attempts, 'attempt')}", duration(piece.seconds)))
        rows += [cells(f"job {name}", value) for name, value in _flat(piece.done.get("job", {}))]
        rows.append(cells("git revision", str(piece.done.get("git_revision", "unknown"))))
    for name, value in piece.description.items():
        if name != "kind":
            rows += _described(name, value, pieces)
    blocks: list[Block] = [Table("Description", ("what", "value"), tuple(rows), labels=2)]
    if card := dict(_flat(_artifact_card(piece))):
        blocks.append(facts("Card of what it left", card))
    return Fold(piece.key, tuple(blocks), anchor_of(piece.key))


def _described(name: str, value: Any, pieces: Mapping[str, Made]) -> list[tuple[Cell, ...]]:
    """Rows for a field; a piece within becomes a link to its card."""
    parts = value if isinstance(value, list) else [value]
    if parts and all(isinstance(part, Mapping) for part in parts):
        return [cells(name, _link(part, pieces)) for part in parts]
    if parts and all(isinstance(part, list) and len(part) == 2 for part in parts):
        return [cells(f"{name} {key}", str(setting)) for key, setting in parts]
    return [cells(name, ", ".join(str(part) for part in parts))]


def _link(description: Mapping[str, Any], pieces: Mapping[str, Made]) -> Cell:
    try:
        key = piece_from_json(dict(description)).key
    except RecordError:
        return Cell(str(description.get("kind", "a piece")))
    return Cell(key, anchor=anchor_of(key) if key in pieces else "")


def _artifact_card(piece: Made) -> Mapping[str, Any]:
    folder = {"dataset": "", "run": "agent"}.get(piece.kind, "encoder")
    directory = piece.directory / folder
    if piece.kind == "dataset":
        directory = dataset_path(piece.directory, str(piece.description.get("domain")))
    try:
        return read_json(directory / "card.json", error=RecordError)
    except CRPTproError:
        return {}


def _flat(content: Any, prefix: str = "", depth: int = 3) -> Iterator[tuple[str, str]]:
    if not isinstance(content, Mapping):
        return
    for name, value in content.items():
        if name in LENGTHY:
            continue
        if isinstance(value, Mapping):
            if depth > 1:
                yield from _flat(value, f"{prefix}{name} ", depth - 1)
        elif value is not None and len(str(value)) <= LONGEST:
            yield f"{prefix}{name}", str(value)

"""What every system took for its score: encoder updates, env steps and wall clock, beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from crptpro.errors import CRPTproError
from crptpro.experiments.budgets import budget, exploration_config, run_config
from crptpro.experiments.durations import duration
from crptpro.experiments.pieces import (
    DatasetPiece,
    EncoderPiece,
    ExploredPiece,
    Piece,
    RunPiece,
    piece_from_json,
)
from crptpro.experiments.records import read_run
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Paragraph, Table, cells, counted
from crptpro.experiments.report.machines import Machines
from crptpro.experiments.report.palette import in_order
from crptpro.experiments.report.reading import Asked, Made, machine
from crptpro.training.action_repeat import action_repeat_of

COLUMNS = (
    "method", "encoders", "encoder updates", "env steps before", "collecting", "pre-training", "runs", "one run",
    "made on",
)  # fmt: skip


def spending(asked: Asked, pieces: Mapping[str, Made]) -> tuple[Block, ...]:
    """Report what the finished runs of an experiment took, and their encoders before them.

    Args:
        asked: the experiment.
        pieces: key to piece, those that runs need among them.
    """
    runs: dict[str, dict[str, RunPiece]] = {}
    for goal in asked.finished:
        piece = _described(goal.piece)
        if isinstance(piece, RunPiece):
            runs.setdefault(goal.label, {})[piece.key] = piece
    if not runs:
        return ()
    machines = Machines()
    lines = [_line(label, list(runs[label].values()), pieces, machines) for label in in_order(runs)]
    caption = (
        "What scores took: means over the encoders and over the runs of a method, wall clock of all attempts. "
        "Pre-training includes its exploring; an encoder that was fine-tuned counts with what it started from, and "
        "data that methods share with each of them."
    )
    text = machines.text()
    return (Table(caption, COLUMNS, tuple(lines)), *([Paragraph(text, "note")] if text else []))


def _line(
    label: str, runs: Sequence[RunPiece], pieces: Mapping[str, Made], machines: Machines
) -> tuple[Cell, ...]:
    """Return a method's row; machines that have no number yet get the next one."""
    encoders = [encoder for encoder in dict.fromkeys(run.encoder for run in runs) if encoder is not None]
    chains = [encoder.lineage for encoder in encoders]
    data = [_datasets(chain) for chain in chains]
    updates = Cell(_mean([_updates(chain) for chain in chains]))
    if not chains:
        updates = Cell(_mean([_updates_with_the_task(run, pieces) for run in runs]), "with the task")
    needed: list[Piece] = [*(e for chain in chains for e in chain), *(d for own in data for d in own), *runs]
    made = [pieces[piece.key].done for piece in needed if piece.key in pieces]
    made_on = machines.numbers_of(_machine(done) for done in made if done is not None)
    return cells(
        label,
        str(len(chains)),
        updates,
        _mean([_env_steps(chain, own) for chain, own in zip(chains, data)]) if chains else "0",
        _time([_seconds(own, pieces) for own in data]) if any(data) else ABSENT,
        _time([_seconds(chain, pieces) for chain in chains]),
        Cell(str(len(runs)), f"{_mean([run_config(run).env_steps for run in runs])} env steps"),
        _time([_seconds([run], pieces) for run in runs]),
        made_on,
    )


def _described(made: Made) -> Piece | None:
    try:
        return piece_from_json(dict(made.description))
    except CRPTproError:
        return None


def _datasets(chain: Iterable[EncoderPiece]) -> list[DatasetPiece]:
    """Return the datasets that a chain learned from, each once."""
    found = (piece for encoder in chain for piece in encoder.needs if isinstance(piece, DatasetPiece))
    return list({piece.key: piece for piece in found}.values())


def _updates(chain: Iterable[EncoderPiece]) -> float | None:
    try:
        return sum(budget(encoder).updates for encoder in chain)
    except CRPTproError:  # a user's own method that is not loaded here
        return None


def _updates_with_the_task(run: RunPiece, pieces: Mapping[str, Made]) -> float | None:
    try:
        return read_run(pieces[run.key].directory).episodes[-1].updates
    except CRPTproError:
        return None


def _env_steps(chain: Iterable[EncoderPiece], data: Iterable[DatasetPiece]) -> float | None:
    collected = sum(piece.transitions * action_repeat_of(piece.domain, None) for piece in data)
    try:
        explored = [exploration_config(e).env_steps for e in chain if isinstance(e, ExploredPiece)]
    except CRPTproError:
        return None
    return collected + sum(float(env_steps or 0) for env_steps in explored)


def _seconds(needed: Sequence[Piece], pieces: Mapping[str, Made]) -> float | None:
    """Return how long pieces took together; ``None`` if that of one of them is not known."""
    total = 0.0
    for piece in needed:
        made = pieces.get(piece.key)
        if made is None or made.seconds is None:
            return None
        total += made.seconds
    return total


def _machine(done: Mapping[str, Any]) -> str:
    job = done.get("job") or {}
    device = str(job.get("device", "cpu"))
    if device == "cpu" and job.get("threads"):
        device = counted(job["threads"], "thread")
    return f"{machine(done.get('hardware') or {})}, {device}"


def _mean(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):,.0f}" if known and len(known) == len(values) else ABSENT


def _time(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return duration(float(np.mean(known))) if known and len(known) == len(values) else ABSENT

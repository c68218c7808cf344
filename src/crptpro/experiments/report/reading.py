"""What a directory holds to report on: the pieces and requests of a reproduction, or runs that nobody planned."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from crptpro.cards import read_json
from crptpro.errors import RecordError
from crptpro.experiments.records import Run, find_runs
from crptpro.experiments.requests import EXPERIMENTS_DIRECTORY, read_request
from crptpro.experiments.store import CLOCK, DESCRIPTION, DONE, LOG, PIECES


@dataclass(frozen=True)
class Made:
    """A piece as it lies on disk, finished or not.

    Args:
        key: name of its directory.
        directory: where it lies.
        description: content of ``piece.json``; empty if there is none yet.
        done: content of ``done.json``; ``None`` if it is not finished.
    """

    key: str
    directory: Path
    description: Mapping[str, Any]
    done: Mapping[str, Any] | None

    @property
    def kind(self) -> str:
        """Kind of piece, also of one that was not begun."""
        return str(self.description.get("kind") or self.key.split("-", 1)[0])

    @property
    def seconds(self) -> float | None:
        """Wall clock of all attempts; ``None`` where it is not known."""
        seconds = (self.done or {}).get("seconds")
        return float(seconds) if isinstance(seconds, (int, float)) else None

    @property
    def state(self) -> str:
        """How far it is, in words."""
        if self.done is not None:
            return "finished"
        # A request describes all of its pieces, so that a directory alone says nothing.
        is_begun = any((self.directory / name).exists() for name in (CLOCK, LOG))
        return "begun, not finished" if is_begun else "not begun"


@dataclass(frozen=True)
class Wanted:
    """A goal of an experiment, with the piece that gives its number.

    Args:
        label: the system or variant.
        place: where it stands otherwise.
        piece: what gives its number.
    """

    label: str
    place: Mapping[str, Any]
    piece: Made

    @property
    def where(self) -> str:
        """The place in words."""
        return ", ".join(f"{name} {value}" for name, value in self.place.items())


@dataclass(frozen=True)
class Asked:
    """One experiment at one scale, as it was asked for.

    Args:
        experiment: its name.
        scale: name of its scale.
        goals: everything it asks for.
    """

    experiment: str
    scale: str
    goals: tuple[Wanted, ...]

    @property
    def name(self) -> str:
        """For anchors and files, whatever the request calls itself."""
        return re.sub(r"[^a-zA-Z0-9]+", "-", f"{self.experiment}-{self.scale}")

    @property
    def finished(self) -> list[Wanted]:
        """Goals whose number can be read."""
        return [goal for goal in self.goals if goal.piece.done is not None]

    @property
    def missing(self) -> list[Wanted]:
        """Goals without a number yet."""
        return [goal for goal in self.goals if goal.piece.done is None]


@dataclass(frozen=True)
class Source:
    """What is reported on.

    Args:
        root: the directory.
        asked: experiments, if it is that of a reproduction.
        pieces: key to every piece below it.
        runs: downstream runs of a directory that is none.
        problems: what could not be read, a sentence each.
    """

    root: Path
    asked: tuple[Asked, ...]
    pieces: Mapping[str, Made]
    runs: tuple[Run, ...] = ()
    problems: tuple[str, ...] = ()

    @cached_property
    def provenance(self) -> list[Mapping[str, Any]]:
        """Versions, hardware and revision of everything finished."""
        records: list[Mapping[str, Any]] = [p.done for p in self.pieces.values() if p.done is not None]
        return records + [run.config for run in self.runs]


def read_source(root: str | Path) -> Source:
    """Read a directory.

    Args:
        root: of a reproduction, or any directory with downstream runs in or below it.

    Raises:
        RecordError: there is no such directory, or nothing in it to report on.
    """
    root = Path(root)
    if not root.is_dir():
        raise RecordError(f"There is no directory {root} to report on.")
    problems: list[str] = []
    pieces = _pieces(root, problems)
    asked = []
    for path in sorted((root / EXPERIMENTS_DIRECTORY).glob("*.json")):
        try:
            asked.append(_asked(root, path, pieces))
        except RecordError as reason:
            problems.append(str(reason))
    if asked:
        return Source(root, tuple(asked), pieces, problems=tuple(problems))
    found = find_runs(root, unfinished=True)
    runs = [run for run in found if run.is_finished]
    problems += [
        f"{run.directory} is not finished: {run.episodes[-1].env_steps:,} of {run.env_steps:,} env steps."
        for run in found
        if not run.is_finished
    ]
    if not runs:
        detail = f" {problems[0]}" if problems else ""
        raise RecordError(
            f"{root} holds nothing to report on: no experiment of `crptpro reproduce` "
            f"({EXPERIMENTS_DIRECTORY}/*.json) and no finished downstream run.{detail}"
        )
    return Source(root, (), pieces, tuple(runs), tuple(problems))


def machine(hardware: Mapping[str, Any]) -> str:
    """Describe the hardware of a record in words."""
    if not hardware:
        return "not recorded"
    gpus: Sequence[str] = hardware.get("gpus") or ()
    ram = float(hardware.get("ram_bytes") or 0) / 2**30
    instructions = f" ({there})" if (there := hardware.get("cpu_instructions")) else ""
    cores = f"{hardware.get('cpu')}{instructions}, {hardware.get('cpu_cores')} cores"
    return f"{cores}, {ram:.0f} GiB, {', '.join(gpus) or 'no GPU'}"


def number(row: Mapping[str, str], column: str) -> float | None:
    """Return a cell as a number; ``None`` for an empty or missing one, or no number at all."""
    try:
        return float(row[column])
    except (KeyError, TypeError, ValueError):
        return None


def _pieces(root: Path, problems: list[str]) -> dict[str, Made]:
    found = {}
    for directory in sorted(path for path in (root / PIECES).glob("*") if path.is_dir()):
        try:
            found[directory.name] = _made(directory)
        except RecordError as reason:
            problems.append(str(reason))
            found[directory.name] = Made(directory.name, directory, {}, None)
    return found


def _made(directory: Path) -> Made:
    description, done = (
        read_json(directory / name, error=RecordError) if (directory / name).exists() else None
        for name in (DESCRIPTION, DONE)
    )
    return Made(directory.name, directory, description or {}, done)


def _asked(root: Path, path: Path, pieces: Mapping[str, Made]) -> Asked:
    record = read_request(path)
    goals = []
    for goal in record.goals:
        piece = pieces.get(goal.key) or Made(goal.key, root / PIECES / goal.key, {}, None)
        goals.append(Wanted(goal.label, dict(goal.place), piece))
    return Asked(record.experiment, record.scale, tuple(goals))

"""What was asked of a reproduction: a file per experiment and scale, from which the report knows what belongs to it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crptpro.cards import read_json, write_json
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import RecordError
from crptpro.experiments.goals import Goal, Request
from crptpro.experiments.pieces import Settings, settings
from crptpro.experiments.store import Store

EXPERIMENTS_DIRECTORY = "experiments"

_RETRY_S = 0.05


@dataclass(frozen=True)
class AskedGoal:
    """One goal as it is written down: its piece is named by its key, and described in the store.

    Args:
        label: row of the tables.
        key: of the piece.
        place: where it stands otherwise.
    """

    label: str
    key: str
    place: Settings = ()


@dataclass(frozen=True)
class Record:
    """What the file of an experiment at one scale holds: everything that was ever asked of it.

    Args:
        experiment: its name.
        scale: name of the scale.
        request: the part that was asked for last.
        goals: of all requests, the last one's first.
    """

    experiment: str
    scale: str
    request: dict[str, Any]
    goals: tuple[AskedGoal, ...]


def request_path(root: Path, experiment: str, scale: str) -> Path:
    """File of an experiment at a scale."""
    return root / EXPERIMENTS_DIRECTORY / f"{experiment}-{scale}.json"


def write_request(store: Store, experiment: str, request: Request, goals: Iterable[Goal]) -> Record:
    """Write down what is asked for, without losing what was asked for before; every goal's piece is described.

    What is asked for takes the place of what stood there: a method that has other numbers since is another piece, and
    a table that had both would average them.

    Args:
        store: of the reproduction.
        experiment: its name.
        request: which part of it.
        goals: that it amounts to.

    Raises:
        RecordError: if the file is there and cannot be read.
    """
    new = []
    for goal in goals:
        store.describe(goal.piece)
        new.append(AskedGoal(goal.label, goal.piece.key, goal.place))
    path = request_path(store.root, experiment, request.scale.name)
    with DirectoryLock(path.parent, error=RecordError, wait=lambda _: time.sleep(_RETRY_S)):
        before = read_request(path).goals if path.exists() else ()
        taken = {(goal.label, goal.place) for goal in new}
        kept = [goal for goal in before if (goal.label, goal.place) not in taken]
        merged = dict.fromkeys([*new, *kept])
        asked = Record(experiment, request.scale.name, _plain(request), tuple(merged))
        content = {
            "experiment": asked.experiment,
            "scale": asked.scale,
            "request": asked.request,
            "goals": [{"label": g.label, "key": g.key, "place": dict(g.place)} for g in asked.goals],
        }
        write_json(path, content)
    return asked


def read_request(path: Path) -> Record:
    """Read what was asked for.

    Raises:
        RecordError: if the file is missing or no such record.
    """
    content = read_json(path, error=RecordError)
    try:
        goals = tuple(AskedGoal(g["label"], g["key"], _settings(g["place"])) for g in content["goals"])
        return Record(content["experiment"], content["scale"], content["request"], goals)
    except (KeyError, TypeError, AttributeError) as reason:
        raise RecordError(
            f"{path} does not say what was asked for ({reason!r}); remove it and ask again."
        ) from reason


def _plain(request: Request) -> dict[str, Any]:
    return {
        "methods": list(request.methods),
        "groups": list(request.groups),
        "tasks": list(request.tasks),
        "encoder_seeds": list(request.encoder_seeds),
        "seeds": list(request.downstream_seeds),
        "colors": request.colors,
        "device": request.device,
        "threads": request.threads,
    }


def _settings(place: dict[str, Any]) -> Settings:
    return settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in place.items()})

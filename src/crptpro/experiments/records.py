"""Finished downstream runs, read back from what they wrote: ``config.json``, ``eval.csv`` and the agent's card."""

from __future__ import annotations

import csv
import json
import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crptpro.artifact import identity_of
from crptpro.errors import RecordError
from crptpro.experiments.statistics import final_score, last_evaluations_score

logger = logging.getLogger(__name__)

CONFIG_NAME, EVALUATIONS_NAME = "config.json", "eval.csv"


@dataclass(frozen=True)
class Episode:
    """One evaluated episode, a row of ``eval.csv``.

    Args:
        env_steps: of the run when it was evaluated; ``agent_steps`` and ``updates`` likewise.
        agent_steps: decisions.
        updates: of the agent.
        episode: number within its evaluation, from 0.
        episode_return: sum of rewards.
        episode_agent_steps: its length in decisions.
        seed: of the episode.
        unix_time_s: when the row was written.
    """

    env_steps: int
    agent_steps: int
    updates: int
    episode: int
    episode_return: float
    episode_agent_steps: int
    seed: int
    unix_time_s: float


@dataclass(frozen=True)
class Run:
    """A downstream run.

    Args:
        directory: where it lies.
        method: as in every row of its evaluations, e.g. ``crptpro``, ``crptpro-finetune``, ``random-encoder``, ``drq``.
        task: what was learned.
        seed: of the downstream stage.
        encoder: identity of the frozen encoder, ``<method>:<sha256 of its weights>``; ``None`` if the run trained its
            own, or if the record does not tell (``trains_encoder`` says which).
        trains_encoder: whether the encoder was learned along with the task, as DrQ's is.
        env_steps: its budget.
        episodes: every evaluated episode, in order.
        config: the content of ``config.json``: settings, versions, hardware, revision.
    """

    directory: Path
    method: str
    task: str
    seed: int
    encoder: str | None
    trains_encoder: bool
    env_steps: int
    episodes: tuple[Episode, ...]
    config: Mapping[str, Any]

    @property
    def settings(self) -> Mapping[str, Any]:
        """What its stage was told."""
        return _stage_settings(self.config)

    @property
    def is_finished(self) -> bool:
        """Whether the evaluation at the end of the budget was made."""
        return self.episodes[-1].env_steps >= self.env_steps

    @property
    def final_score(self) -> float:
        """Mean return of the final evaluation's episodes."""
        return final_score(*self._columns())

    def last_score(self, evaluations: int = 10) -> float:
        """Mean return over the last evaluations."""
        return last_evaluations_score(*self._columns(), evaluations=evaluations)

    def _columns(self) -> tuple[list[int], list[float]]:
        return [e.env_steps for e in self.episodes], [e.episode_return for e in self.episodes]


def find_runs(*roots: str | Path, unfinished: bool = False) -> list[Run]:
    """Read every downstream run in or below directories.

    A run is a directory with a ``config.json`` and an ``eval.csv``. What looks like one and cannot be read, or has
    not spent its budget, is left out with a warning that names it and says why.

    Args:
        *roots: where to look; a run found twice counts once.
        unfinished: keep runs that go on or were interrupted, as far as they got (learning curves).

    Returns:
        The runs, sorted by method, task, seed and directory.

    Raises:
        RecordError: if a root does not exist.
    """
    runs = []
    for directory in _candidates(roots):
        try:
            run = read_run(directory)
        except RecordError as reason:
            logger.warning("Left out: %s", reason)
            continue
        if run.is_finished or unfinished:
            runs.append(run)
        else:
            logger.warning(
                "Left out: %s is at %s of %s env steps.",
                directory, f"{run.episodes[-1].env_steps:,}", f"{run.env_steps:,}",
            )  # fmt: skip
    return sorted(runs, key=lambda run: (run.method, run.task, run.seed, str(run.directory)))


def read_run(directory: str | Path) -> Run:
    """Read one downstream run.

    Args:
        directory: its run directory.

    Returns:
        The run; of an evaluation that is still under way, nothing.

    Raises:
        RecordError: naming the file and what is wrong with it: missing, torn, a cell that is no number, rows of two
            methods, an episode twice, an earlier evaluation with other than the configured number of episodes.
    """
    directory = Path(directory)
    config = _read_json(directory / CONFIG_NAME)
    outer, settings = config.get("config", {}), _stage_settings(config)
    try:
        task, seed, env_steps = str(outer["task"]), int(settings["seed"]), int(settings["env_steps"])
        eval_episodes = int(settings["eval_episodes"])
    except (KeyError, TypeError, ValueError, AttributeError) as reason:
        raise RecordError(
            f"{directory / CONFIG_NAME} is not that of a downstream run: {type(reason).__name__}: {reason}."
        ) from None
    method, episodes = _read_evaluations(directory / EVALUATIONS_NAME, eval_episodes)
    trains_encoder = settings.get("algorithm") == "drq"
    encoder = None if trains_encoder else _encoder_identity(directory, outer)
    return Run(directory, method, task, seed, encoder, trains_encoder, env_steps, episodes, config)


def _stage_settings(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The command line keeps the stage's settings within its request, a program beside the task."""
    outer = config.get("config", {})
    return outer.get("config", outer)


def _candidates(roots: Iterable[str | Path]) -> list[Path]:
    found: dict[Path, Path] = {}
    for root in map(Path, roots):
        if not root.is_dir():
            raise RecordError(f"There is no directory {root} to look for runs in.")
        for name in (EVALUATIONS_NAME, CONFIG_NAME):
            for path in root.rglob(name):
                if name == EVALUATIONS_NAME or _is_downstream(path):
                    found.setdefault(path.parent.resolve(), path.parent)
    return sorted(found.values())


def _is_downstream(path: Path) -> bool:
    """Whether a config without evaluations is that of a run that should have some; other stages have none."""
    try:
        config = _read_json(path)
        return "task" in config.get("config", {}) and "eval_episodes" in _stage_settings(config)
    except (RecordError, AttributeError, TypeError):
        return False


def _read_evaluations(path: Path, eval_episodes: int) -> tuple[str, tuple[Episode, ...]]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RecordError(f"{path.parent} has no {path.name}: nothing was evaluated yet.") from None
    except (OSError, UnicodeDecodeError) as reason:
        raise RecordError(f"{path} cannot be read: {reason}.") from None
    if not text.endswith("\n"):
        raise RecordError(f"{path} ends within a row: it is being written, or was cut.")
    rows = list(csv.DictReader(text.splitlines()))
    if not rows:
        raise RecordError(f"{path} has no rows.")
    if "method" not in rows[0]:
        raise RecordError(f"{path} has no column `method`: it was written by an older version.")
    episodes = tuple(_episode(path, number, row) for number, row in enumerate(rows, start=2))
    methods = sorted({row["method"] for row in rows})
    if len(methods) > 1:
        raise RecordError(f"{path} has rows of several methods: {', '.join(methods)}.")
    twice = [k for k, n in Counter((e.env_steps, e.episode) for e in episodes).items() if n > 1]
    if twice:
        raise RecordError(f"{path} has episode {twice[0][1]} at {twice[0][0]:,} env steps twice.")
    for at, count in Counter(e.env_steps for e in episodes).items():
        if at == episodes[-1].env_steps and count < eval_episodes:
            episodes = tuple(e for e in episodes if e.env_steps != at)  # still under way
        elif count != eval_episodes:
            raise RecordError(
                f"{path} has {count} episodes at {at:,} env steps, {eval_episodes} were asked for."
            )
    if not episodes:
        raise RecordError(f"{path} has no complete evaluation yet.")
    return methods[0], episodes


def _episode(path: Path, line: int, row: Mapping[str | None, Any]) -> Episode:
    try:
        if None in row or None in row.values() or not row["method"]:
            raise ValueError("it has too few or too many cells")
        episode = Episode(
            env_steps=int(row["env_steps"]),
            agent_steps=int(row["agent_steps"]),
            updates=int(row["updates"]),
            episode=int(row["episode"]),
            episode_return=float(row["episode_return"]),
            episode_agent_steps=int(row["episode_agent_steps"]),
            seed=int(row["seed"]),
            unix_time_s=float(row["unix_time_s"]),
        )
        if not math.isfinite(episode.episode_return) or not math.isfinite(episode.unix_time_s):
            raise ValueError("a number in it is not finite")
        return episode
    except (KeyError, ValueError) as reason:
        raise RecordError(f"{path} is damaged in line {line}: {type(reason).__name__}: {reason}.") from None


def _encoder_identity(directory: Path, request: Mapping[str, Any]) -> str | None:
    """From the agent's card, which a finished run has; else from the artifact that the command line named."""
    card = _card(directory / "agent" / "card.json")
    if card.get("pretrained"):
        return str(card["pretrained"])
    if isinstance(request.get("pretrained"), str):
        return identity_of(_card(Path(request["pretrained"]) / "card.json"))
    return None


def _card(path: Path) -> Mapping[str, Any]:
    try:
        return _read_json(path)
    except RecordError:
        return {}


def _read_json(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordError(f"{path.parent} has no {path.name}.") from None
    except (OSError, ValueError) as reason:
        raise RecordError(f"{path} cannot be read: {reason}.") from None
    if not isinstance(content, Mapping):
        raise RecordError(f"{path} holds no settings.")
    return content

"""A finished reproduction without any training: pieces and requests by the library, numbers by hand."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from toy_world import ToyEnv, fixed_length

from crptpro.cards import write_json
from crptpro.data.collect_worker import EpisodeRoller
from crptpro.data.collection import DomainCollection
from crptpro.experiments.goals import Goal
from crptpro.experiments.pieces import EncoderPiece, Piece, PretrainedPiece, RunPiece
from crptpro.experiments.records import Episode
from crptpro.experiments.store import DONE, Store

START_S = 1_795_000_000.0
MADE = {
    "versions": {"python": "3.11.7", "crptpro": "0.1.0", "torch": "2.13.0"},
    "hardware": {"cpu": "A CPU", "cpu_cores": 2, "ram_bytes": 24 * 2**30, "gpus": []},
    "git_revision": "0123456789ab",
}
EVALUATIONS, EPISODES = 11, 2
BUDGET = 20_000


@dataclasses.dataclass(frozen=True)
class Measurement(Piece):
    """Stands for the pieces that leave one table; its kind is given and not registered."""

    name: str
    seed: int = 0

    @property
    def title(self) -> str:
        return self.name

    def to_json(self) -> dict[str, Any]:
        kind, _ = self.name.split(" ", 1)
        return {"kind": kind, "name": self.name, "seed": self.seed}

    @property
    def key(self) -> str:  # type: ignore[override]
        return f"{self.name.replace(' ', '-')}-{self.seed}"


def write_table(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = list(rows)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_run(
    directory: Path,
    *,
    method: str,
    task: str,
    score: float,
    seed: int = 0,
    encoder: str | None = None,
    colors: str = "normal",
    budget: int = BUDGET,
    pause_s: float = 0.0,
) -> None:
    """A run whose curve rises linearly from 0 to ``score``, an hour long, with a pause before its last evaluation."""
    settings = {
        "algorithm": "drq" if method == "drq" else "rad-sac", "seed": seed, "env_steps": budget,
        "eval_episodes": EPISODES, "colors": colors,
    }  # fmt: skip
    write_json(directory / "config.json", {"config": {"task": task, **settings}, **MADE})
    rows = []
    for place in range(EVALUATIONS):
        share = place / (EVALUATIONS - 1)
        for episode in range(EPISODES):
            at = START_S + 3600 * share + (pause_s if share == 1 else 0)
            noise = 2 * episode - 1
            env_steps = int(budget * share)
            row = Episode(
                env_steps,
                env_steps // 2,
                env_steps // 2,
                episode,
                score * share + noise,
                500,
                7 + episode,
                at,
            )
            rows.append({"method": method, **dataclasses.asdict(row)})
    write_table(directory / "eval.csv", rows)
    if encoder is not None:
        write_json(directory / "agent" / "card.json", {"pretrained": encoder})


class Reproduction:
    """Fills a root piece by piece.

    Args:
        root: of the reproduction.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.store = root, Store(root)

    def ask(self, experiment: str, goals: Iterable[Goal], scale: str = "small") -> None:
        goals = list(goals)
        for goal in goals:
            self.store.describe(goal.piece)
        listed = [{"label": g.label, "key": g.piece.key, "place": dict(g.place)} for g in goals]
        content = {"experiment": experiment, "scale": scale, "request": {}, "goals": listed}
        write_json(self.root / "experiments" / f"{experiment}-{scale}.json", content)

    def finish(self, piece: Piece) -> Path:
        directory = self.store.path(piece)
        self.store.describe(piece)
        write_json(directory / DONE, {"seconds": 90.0, "job": {"device": "cpu", "threads": 1}, **MADE})
        return directory

    def run(self, goal: Goal, score: float, **options: Any) -> Path:
        piece = goal.piece
        assert isinstance(piece, RunPiece)
        identity = None if piece.encoder is None else f"{piece.encoder.method}:{piece.encoder.key}"
        method = "drq" if piece.encoder is None else piece.encoder.method
        directory = self.finish(piece)
        write_run(
            directory, method=method, task=piece.task, score=score, seed=piece.seed, encoder=identity,
            colors=piece.colors, **options,
        )  # fmt: skip
        return directory

    def encoder(self, piece: EncoderPiece, *, plateau: int, num_prototypes: int = 128) -> Path:
        """An encoder whose comparative loss leaves ln M after so many updates."""
        directory = self.finish(piece)
        uniform = math.log(num_prototypes)
        rows = []
        for updates in range(20, 1001, 20):
            fallen = max(updates - plateau, 0) / 1000
            rows.append(
                {
                    "updates": updates, "unix_time_s": START_S + updates, "comp": uniform * (1 - fallen),
                    "embedding_cosine": 1 - fallen, "assignment_entropy_frac": 1 - fallen / 2,
                    "prototypes_in_use": 100, "prototype_ane": -1e-4, "ln_num_prototypes": uniform,
                }
            )  # fmt: skip
        write_table(directory / "pretrain.csv", rows)
        return directory

    def dataset(self, goal: PretrainedPiece) -> None:
        """Make the datasets of an encoder, of a toy world's pictures."""
        for piece in goal.datasets:
            directory = self.finish(piece) / piece.domain
            settings = {"image_size": 24, "action_repeat": 2, "camera": 0, "quality": "exact"}
            task = f"{piece.domain}_go"
            request = {"domain": piece.domain, "task": task, "seed": 0, "transitions": 27, **settings}
            collection = DomainCollection(directory, request, 10)
            roller = EpisodeRoller(lambda: ToyEnv(fixed_length, image_size=24))
            while (job := collection.next_job()) is not None:
                collection.accept(job.episode, roller.roll(job))
            roller.close()
            collection.close()

    def measure(
        self, kind: str, rows: Iterable[Mapping[str, Any]], seed: int = 0, name: str = "one"
    ) -> Measurement:
        piece = Measurement(f"{kind} {name}", seed)
        write_table(self.finish(piece) / f"{kind}.csv", rows)
        return piece


def pictures(count: int = 12) -> torch.Tensor:
    """A video in which a bright bar travels: uint8 ``[T, 3, 84, 84]``."""
    video = torch.zeros(count, 3, 84, 84, dtype=torch.uint8)
    for place in range(count):
        video[place, :, :, 7 * place : 7 * place + 7] = 255
    return video

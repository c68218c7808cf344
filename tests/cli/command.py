"""What the tests of the command share: how it is called, what a refusal is, a dataset without a simulator."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

from toy_world import FIXED, ToyEnv, fixed_length

from crptpro.data.collect_worker import EpisodeRoller
from crptpro.data.collection import DomainCollection

SIZE = 16
TASK = FIXED.task
SMALL_DRQ = (
    "--env-steps", 60, "--random-agent-steps", 12, "--batch-size", 4, "--replay-capacity", 20,
    "--eval-episodes", 1, "--eval-interval-env-steps", 20, "--checkpoint-interval-env-steps", 20,
    "--log-interval-env-steps", 10, "--precision", "fp32", "--hidden-dim", 32,
)  # fmt: skip
SMALL = (*SMALL_DRQ, "--queue-size", 512)

Call = Callable[..., tuple[int, str, str]]


def refused(result: tuple[int, str, str]) -> str:
    """The one line of a refusal."""
    status, out, err = result
    assert status == 1
    assert out == ""
    assert len(err.splitlines()) == 1, err
    assert err.startswith("error: ")
    return err


def toy_dataset(path: Path, size: int = SIZE) -> Path:
    settings = {"image_size": size, "action_repeat": 2, "camera": 0, "quality": "exact"}
    request = {"domain": path.name, "task": f"{path.name}_go", "seed": 0, "transitions": 27, **settings}
    collection = DomainCollection(path, request, 10)
    roller = EpisodeRoller(lambda: ToyEnv(fixed_length, image_size=size))
    while (job := collection.next_job()) is not None:
        collection.accept(job.episode, roller.roll(job))
    roller.close()
    collection.close()
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))

"""What the tests of the command share: how it is called, what a refusal is, a dataset without a simulator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pandas as pd
from toy_env import FIXED, random_episode, write_dataset

SIZE = 16
TASK = FIXED.task
FEW = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
SMALL = (
    "--env-steps", 60, "--random-agent-steps", 12, "--batch-size", 4, "--replay-capacity", 20,
    "--eval-episodes", 1, "--eval-interval-env-steps", 20, "--checkpoint-interval-env-steps", 20,
    "--log-interval-env-steps", 10, "--precision", "fp32", "--hidden-dim", 32, "--queue-size", 512,
)  # fmt: skip

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
    episodes = [random_episode(10, size=size, seed=index) for index in range(6)]
    return write_dataset(path, episodes, domain=path.name)


def rows(path: Path | str) -> list[dict[str, str]]:
    return pd.read_csv(path, dtype=str, keep_default_na=False).to_dict("records")

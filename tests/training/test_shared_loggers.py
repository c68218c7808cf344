"""One logger for several runs: a run that starts takes back its own rows only."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from pretrain_world import SETTINGS, make_datasets
from pretrain_world import make_loss as make_passive_loss
from test_downstream import train

from crptpro.loggers import RunLogger
from crptpro.training import pretrain, pretrain_active

sys.path.insert(0, str(Path(__file__).parent / "explore"))

from active_world import SMALL as ACTIVE
from active_world import make_loss as make_active_loss
from active_world import toy_env as active_env


def downstream_run(run_dir: Path | None, logger: RunLogger) -> None:
    train(run_dir, logger=logger, env_steps=40)


def passive_run(run_dir: Path | None, logger: RunLogger) -> None:
    pretrain(make_passive_loss(), make_datasets(), updates=8, run_dir=run_dir, logger=logger, **SETTINGS)


def active_run(run_dir: Path | None, logger: RunLogger) -> None:
    options: dict[str, Any] = {"config": ACTIVE, "env_factory": active_env, "progress": False}
    pretrain_active(make_active_loss(), ["even"], run_dir=run_dir, logger=logger, **options, env_steps=80)


STAGES = [(downstream_run, "eval"), (passive_run, "pretrain"), (active_run, "pretrain")]


@pytest.mark.parametrize(("start", "stream"), STAGES)
@pytest.mark.parametrize("has_directory", [False, True])
def test_a_run_leaves_the_rows_of_another_run_in_a_shared_logger(
    tmp_path: Path, start: Any, stream: str, has_directory: bool
) -> None:
    with RunLogger(tmp_path / "record") as logger:
        start(tmp_path / "first" if has_directory else None, logger)
        rows = logger.rows(stream)
        start(tmp_path / "second" if has_directory else None, logger)
        assert rows
        assert logger.rows(stream)[: len(rows)] == rows
        assert len(logger.rows(stream)) == 2 * len(rows)


@pytest.mark.parametrize(("start", "stream"), STAGES)
@pytest.mark.parametrize("place", [".", "record"])
def test_rows_of_an_attempt_without_a_checkpoint_are_taken_back_in_the_runs_own_directory(
    tmp_path: Path, start: Any, stream: str, place: str
) -> None:
    with RunLogger(tmp_path / place) as logger:
        logger.log({"loss": 1.0}, stream=stream, updates=3, env_steps=7)
        start(tmp_path, logger)
        assert 7 not in [row.get("env_steps") for row in logger.rows(stream)]

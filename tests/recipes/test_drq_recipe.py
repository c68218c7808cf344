from __future__ import annotations

import dataclasses
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from recipe_process import (
    RECIPES,
    SHORT_TASK,
    command_of,
    environment,
    free_replays,
    records,
    rows,
    run_recipe,
)  # fmt: skip

from crptpro.training import drq_settings, load_agent

FLAGS = (
    "--tasks", SHORT_TASK, "--quality", "fast", "--precision", "fp32", "--drq.env-steps", 160,
    "--drq.random-agent-steps", 20, "--drq.batch-size", 4, "--drq.replay-capacity", 60, "--drq.hidden-dim", 16,
    "--drq.eval-episodes", 1, "--drq.eval-interval-env-steps", 50, "--drq.checkpoint-interval-env-steps", 50,
    "--drq.log-interval-env-steps", 10,
)  # fmt: skip
RUN = f"{SHORT_TASK}_drq_seed_0"


def test_the_recipe_has_the_numbers_of_the_library() -> None:
    spec = importlib.util.spec_from_file_location("drq_recipe", RECIPES / "drq.py")
    recipe = importlib.util.module_from_spec(spec)
    sys.modules["drq_recipe"] = recipe
    try:
        spec.loader.exec_module(recipe)
    finally:
        del sys.modules["drq_recipe"]
    assert drq_settings(**vars(recipe.DrQ())) == drq_settings()
    assert set(vars(recipe.DrQ())) <= {field.name for field in dataclasses.fields(drq_settings())}
    assert len(recipe.Config().tasks) == 8


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The directory of a recipe that was killed once it had learned for a while, and started again."""
    out = tmp_path_factory.mktemp("drq") / "killed"
    process = subprocess.Popen(
        command_of("drq", "--out", out, *FLAGS),
        env=environment(),
        start_new_session=True,
        stderr=subprocess.PIPE,
    )
    deadline = time.monotonic() + 240
    while not list((out / RUN / "checkpoints").glob("checkpoint-*0050-*.pt")):
        assert process.poll() is None, process.communicate()[1].decode()[-4000:]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    run_recipe("drq", "--out", out, *FLAGS)
    yield out
    free_replays(out)


@pytest.mark.gl
@pytest.mark.slow
def test_a_killed_recipe_ends_with_evaluations_and_an_agent_from_pixels(out: Path) -> None:
    assert [row["env_steps"] for row in rows(out / RUN / "eval.csv")] == ["0", "50", "100", "150", "160"]
    training = rows(out / RUN / "train.csv")
    assert [row["env_steps"] for row in training] == [str(steps) for steps in range(50, 161, 10)]
    assert training[-1]["updates"] == "60"
    agent, card = load_agent(out / RUN / "agent")
    assert card["pretrained"] is None
    assert card["config"]["algorithm"] == "drq"
    assert agent.actor.config["has_tanh"]


@pytest.mark.gl
@pytest.mark.slow
def test_a_second_call_changes_no_record(out: Path) -> None:
    before = records(out)
    run_recipe("drq", "--out", out, *FLAGS)
    assert records(out) == before

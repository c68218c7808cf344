from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from matplotlib.image import imread
from recipe_process import SHORT_TASK, free_replays, kill_recipe, records, rows, run_recipe

from crptpro.data import FrameDataset
from crptpro.pretrained import load_pretrained
from crptpro.training import load_agent

pytestmark = [pytest.mark.gl, pytest.mark.slow]

ENV_STEPS = 100
FLAGS = (
    "--domains", "cartpole", "pendulum", "--transitions", 30, "--workers", 1, "--pretrain-updates", 8,
    "--pretrain-batch-size", 8, "--task", SHORT_TASK, "--env-steps", ENV_STEPS, "--batch-size", 8,
    "--episodes", 2,
)  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[str]]]:
    """The directory of a quickstart that was killed while pre-training and started again, and what it had then."""
    out = tmp_path_factory.mktemp("quickstart") / "run"
    kill_recipe(out, "pretrain", "quickstart", *FLAGS)
    kept = [name for name in ("data", "pretrain", "encoder", "report.md") if (out / name).exists()]
    run_recipe("quickstart", "--out", out, *FLAGS)
    yield out, kept
    free_replays(out)


def test_killed_halfway_the_same_command_completes(finished: tuple[Path, list[str]]) -> None:
    out, kept = finished
    assert kept == ["data", "pretrain"]
    for name in ("cartpole", "pendulum"):
        dataset = FrameDataset.open(out / "data" / name)
        assert len(dataset) == 30
        dataset.verify()
    assert rows(out / "pretrain" / "pretrain.csv")[-1]["updates"] == "8"


def test_report_and_figures_show_what_was_measured(finished: tuple[Path, list[str]]) -> None:
    out, _ = finished
    report = (out / "report.md").read_text()
    scores = json.loads((out / "scores.json").read_text())["scores"]
    assert set(scores) == {"trained agent", "uniform random policy"}
    for policy, values in scores.items():
        assert re.search(rf"\| {policy} \| {re.escape(format(values['mean'], '.1f'))} ", report)
    figures = re.findall(r"!\[.*\]\((.+\.png)\)", report)
    assert len(figures) == len(set(figures)) == 4
    for figure in figures:
        assert imread(out / figure).std() > 0.01, figure


def test_encoder_agent_and_evaluations_are_left_for_use(finished: tuple[Path, list[str]]) -> None:
    out, _ = finished
    pretrained = load_pretrained(out / "encoder", expect={"image_size": 84, "prototypes": True})
    assert pretrained.card["training"]["updates"] == 8
    agent, card = load_agent(out / "downstream" / "agent")
    assert (card["task"], card["env_steps"]) == (SHORT_TASK, ENV_STEPS)
    assert card["pretrained"] == pretrained.identity()
    for key, value in pretrained.encoder.state_dict().items():
        assert torch.equal(agent.encoder.state_dict()[key], value), key
    action = agent(torch.zeros(9, 84, 84, dtype=torch.uint8))
    assert action.shape == (2,)
    assert action.abs().max() <= 1
    evaluations = rows(out / "downstream" / "eval.csv")
    # An episode has 50 env steps, which are 13 decisions of 4; the second is cut by the budget.
    assert {row["env_steps"] for row in evaluations} == {"0", "52", str(ENV_STEPS)}
    assert all(float(row["episode_return"]) < 0 for row in evaluations)  # reacher pays by distance
    assert [row["env_steps"] for row in rows(out / "downstream" / "episodes.csv")] == ["52", "100"]


def test_a_second_call_is_quick_and_changes_no_record(finished: tuple[Path, list[str]]) -> None:
    out, _ = finished
    before, start = records(out), time.monotonic()
    run_recipe("quickstart", "--out", out, *FLAGS)
    seconds = time.monotonic() - start
    assert records(out) == before
    assert seconds < 60

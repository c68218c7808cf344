from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from recipe_process import SHORT_TASK, free_replays, records, rows, run_recipe

from crptpro.pretrained import load_pretrained
from crptpro.training import load_agent

pytestmark = [pytest.mark.gl, pytest.mark.slow]

DOWNSTREAM = (
    "--tasks", SHORT_TASK, "--downstream.env-steps", 80, "--downstream.random-agent-steps", 20,
    "--downstream.batch-size", 4, "--downstream.replay-capacity", 60, "--downstream.eval-episodes", 1,
    "--downstream.eval-interval-env-steps", 40, "--downstream.checkpoint-interval-env-steps", 40,
    "--downstream.log-interval-env-steps", 10, "--downstream.queue-size", 32, "--quality", "fast",
)  # fmt: skip
PRETRAINING = (
    "--group", "D", "--transitions", 12, "--workers", 1, "--updates", 4, "--pretrain-batch-size", 4,
    "--num-prototypes", 16, "--latent-dim", 8, "--hidden-dim", 16,
)  # fmt: skip


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    out = tmp_path_factory.mktemp("recipe")
    run_recipe("crptpro", "--out", out, *PRETRAINING, *DOWNSTREAM)
    yield out
    free_replays(out)


def test_one_encoder_of_the_group_serves_the_task(out: Path) -> None:
    assert sorted(path.name for path in (out / "data").iterdir()) == ["hopper", "pendulum", "walker"]
    pretrained = load_pretrained(out / "group_D_seed_0" / "encoder", expect={"prototypes": True})
    facts = pretrained.card["training"]["datasets"]
    assert [fact["domain"] for fact in facts] == ["walker", "pendulum", "hopper"]
    run_dir = out / f"{SHORT_TASK}_group_D_seed_0"  # the same task on another group's encoder has its own
    agent, card = load_agent(run_dir / "agent")
    assert card["pretrained"] == pretrained.identity()
    assert agent.actor.action_dim == 2
    assert [row["env_steps"] for row in rows(run_dir / "eval.csv")] == ["0", "50", "80"]
    training = rows(run_dir / "train.csv")
    assert training[-1]["updates"] == "20"
    assert all(float(row["intrinsic_reward"]) >= 0 for row in training)


def test_a_second_call_is_quick_and_changes_no_record(out: Path) -> None:
    before, start = records(out), time.monotonic()
    run_recipe("crptpro", "--out", out, *PRETRAINING, *DOWNSTREAM)
    assert time.monotonic() - start < 40
    assert records(out) == before

from __future__ import annotations

import time
from pathlib import Path

import pytest
import torch
from recipe_process import SHORT_TASK, free_replays, records, rows, run_recipe

from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import load_agent

pytestmark = [pytest.mark.gl, pytest.mark.slow]

FLAGS = (
    "--domain", SHORT_TASK, "--updates", 3, "--transitions", 30, "--batch-size", 4, "--workers", 1,
    "--quality", "fast", "--downstream.env-steps", 50, "--downstream.random-agent-steps", 5,
    "--downstream.batch-size", 4, "--downstream.replay-capacity", 60, "--downstream.eval-episodes", 1,
    "--downstream.log-interval-env-steps", 10, "--downstream.queue-size", 32,
)  # fmt: skip


def test_an_encoder_moves_to_one_domain_and_serves_its_task(tmp_path: Path) -> None:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(), num_prototypes=16, latent_dim=8, hidden_dim=16)
    source = save_pretrained(loss, tmp_path / "source")
    out = tmp_path / "out"
    run_recipe("finetune", source, "--out", out, *FLAGS)

    (encoder,), (agent,) = out.rglob("encoder"), out.rglob("agent")
    before, after = load_pretrained(source), load_pretrained(encoder)
    weights = [pretrained.encoder.state_dict() for pretrained in (before, after)]
    assert any(not torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert after.card["training"]["updates"] == 3
    assert after.card["training"]["started_from"] == before.identity()
    _, card = load_agent(agent)
    assert card["task"] == SHORT_TASK
    assert card["pretrained"] == after.identity()
    assert [row["env_steps"] for row in rows(agent.parent / "eval.csv")] == ["0", "50"]

    kept, start = records(out), time.monotonic()
    run_recipe("finetune", source, "--out", out, *FLAGS)
    assert time.monotonic() - start < 30
    assert records(out) == kept
    free_replays(out)

from __future__ import annotations

import time
from pathlib import Path

import pytest
from recipe_process import SHORT_TASK, free_replays, records, rows, run_recipe

from crptpro.pretrained import load_pretrained
from crptpro.training import load_agent

pytestmark = [pytest.mark.gl, pytest.mark.slow]

FLAGS = (
    "--world", SHORT_TASK, "--transitions", 30, "--updates", 2, "--env-steps", 50, "--batch-size", 4,
    "--workers", 1, "--quality", "fast",
)  # fmt: skip


def test_a_loss_that_the_library_does_not_know_goes_all_the_way(tmp_path: Path) -> None:
    said = run_recipe("own_domain", "--out", tmp_path, *FLAGS).stderr
    assert said.count("no exploration bonus: the artifact has no prototypes") == 1
    pretrained = load_pretrained(tmp_path / "encoder")
    assert pretrained.method == "next-latent"
    assert pretrained.projector is not None
    assert pretrained.prototypes is None
    pretraining = rows(tmp_path / "pretrain" / "pretrain.csv")
    assert 0 <= float(pretraining[-1]["loss_prediction"]) <= 4
    _, card = load_agent(tmp_path / "downstream" / "agent")
    assert card["pretrained"] == pretrained.identity()
    evaluations = rows(tmp_path / "downstream" / "eval.csv")
    assert [row["env_steps"] for row in evaluations] == ["0", "0", "50", "50"]

    kept, start = records(tmp_path), time.monotonic()
    run_recipe("own_domain", "--out", tmp_path, *FLAGS)
    assert time.monotonic() - start < 30
    assert records(tmp_path) == kept
    free_replays(tmp_path)

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from crptpro.training import load_agent


def record(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return [
            {key: value for key, value in row.items() if "time" not in key} for row in csv.DictReader(file)
        ]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """Where the runs of all modes are, and how often each was killed."""
    root = tmp_path_factory.mktemp("runs")
    script = Path(__file__).with_name("downstream_kill_target.py")
    output = subprocess.run(
        [sys.executable, str(script), str(root), "1"],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert output.returncode == 0, output.stderr[-4000:]
    return root, [int(kills) for kills in output.stdout.split()]


@pytest.mark.parametrize("features", ["dense", "reencode", "trained"])
def test_killed_at_random_moments_it_completes_with_the_same_records_and_agent(
    runs: tuple[Path, list[int]], features: str
) -> None:
    root, kills = runs
    assert len(kills) == 3
    assert min(kills) >= 2
    whole, killed = root / features / "whole", root / features / "killed"
    for name in ("eval.csv", "train.csv", "episodes.csv"):
        assert record(killed / name) == record(whole / name), name
    assert [int(row["env_steps"]) for row in record(whole / "eval.csv")][::2] == [0, 60, 120, 180, 240]
    (agent, card), (expected, _) = load_agent(killed / "agent"), load_agent(whole / "agent")
    assert card["feature_mode"] == features
    assert card["env_steps"] == 240
    for network, twin in ((agent.actor, expected.actor), (agent.encoder, expected.encoder)):
        for key, value in twin.state_dict().items():
            assert torch.equal(network.state_dict()[key], value), key

from __future__ import annotations

import csv
import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from dying import killed_in
from tensordict import TensorDict
from test_downstream import EPISODE, SMALL, small_pretrained
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.seeding import seed_everything
from crptpro.training import load_agent, train_downstream
from crptpro.training.downstream_run import DownstreamRun


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


class LuckyEnv(ToyEnv):
    """Its rewards come from the global generators of Python and NumPy."""

    def _step(self, tensordict: TensorDict) -> TensorDict:
        found = super()._step(tensordict)
        found["reward"] += random.random() + np.random.rand()  # noqa: NPY002 - what many worlds draw from
        return found


def lucky_env(task: str, *, seed: int, image_size: int, frame_stack: int, **settings: object) -> EnvBase:
    env = LuckyEnv(lambda _: EPISODE, seed=seed, image_size=image_size)
    return TransformedEnv(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


def test_a_world_that_draws_from_pythons_and_numpys_generators_goes_on_with_the_same_numbers(
    tmp_path: Path,
) -> None:
    def train(run_dir: Path) -> None:
        train_downstream(
            "toy", small_pretrained(), run_dir=run_dir, config=SMALL, env_factory=lucky_env, progress=False
        )

    train(tmp_path / "whole")
    with killed_in(DownstreamRun, "run_episode", lambda run: run.episodes == 4):
        train(tmp_path / "killed")
    seed_everything(99)
    train(tmp_path / "killed")
    for name in ("eval.csv", "train.csv", "episodes.csv"):
        assert record(tmp_path / "killed" / name) == record(tmp_path / "whole" / name), name

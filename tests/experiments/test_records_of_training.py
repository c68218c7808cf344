from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.experiments.records import find_runs
from crptpro.experiments.score_table import score_tables
from crptpro.modules import PixelEncoder
from crptpro.pretrained import Pretrained
from crptpro.training import DownstreamConfig, train_downstream

SMALL = DownstreamConfig(
    env_steps=40,
    batch_size=4,
    replay_capacity=20,
    random_agent_steps=18,
    eval_interval_env_steps=20,
    eval_episodes=2,
    checkpoint_interval_env_steps=20,
    log_interval_env_steps=20,
    intrinsic_reward_coef=0.0,
    precision="fp32",
    eval_workers=0,
)


def toy_env(task: str, *, seed: int, image_size: int, frame_stack: int, **settings: object) -> EnvBase:
    env = ToyEnv(lambda _: 10, seed=seed, image_size=image_size)
    return TransformedEnv(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


@pytest.fixture
def pretrained() -> Pretrained:
    torch.manual_seed(0)
    return Pretrained(PixelEncoder(channels=(4,), strides=(2,), image_size=16), card={"method": "atc"})


def test_what_training_leaves_is_read_as_one_table(tmp_path: Path, pretrained: Pretrained) -> None:
    evaluations = {}
    for seed in (0, 1):
        evaluations[seed] = train_downstream(
            "toy",
            pretrained,
            run_dir=tmp_path / str(seed),
            config=SMALL,
            seed=seed,
            progress=False,
            env_factory=toy_env,
        ).evaluations
    runs = find_runs(tmp_path)
    assert [(run.method, run.task, run.seed, run.encoder) for run in runs] == [
        ("atc", "toy", seed, pretrained.identity()) for seed in (0, 1)
    ]
    for run in runs:
        rows = evaluations[run.seed]
        assert [e.episode_return for e in run.episodes] == [row["episode_return"] for row in rows]
        assert run.final_score == pytest.approx(sum(row["episode_return"] for row in rows[-2:]) / 2)
    table = score_tables(runs)["atc"]
    assert table.encoders == {"toy": (pretrained.identity(),) * 2}
    assert len(table.scores["toy"]) == 2

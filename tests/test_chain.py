"""The whole chain in one process tree, without a simulator or GL: what a clean machine can always run."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from toy_world import FIXED, VARIABLE

from crptpro.data import collect_group
from crptpro.envs import make_env
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import evaluate, load_agent, pretrain, train_downstream


def test_collect_pretrain_freeze_and_learn(tmp_path: Path) -> None:
    paths = collect_group([FIXED, VARIABLE], tmp_path / "data", transitions=100, image_size=12, progress=False)
    encoder = PixelEncoder(channels=(4, 4), strides=(2, 1), image_size=12)
    loss = ProtoLoss(encoder, num_prototypes=8, latent_dim=4, hidden_dim=16)
    before = encoder.convs[0].weight.clone()
    result = pretrain(loss, paths, updates=5, batch_size=8, precision="fp32", progress=False)
    assert math.isfinite(result.metrics["loss"])
    assert not torch.equal(encoder.convs[0].weight, before)
    save_pretrained(result, tmp_path / "encoder")

    artifact = load_pretrained(tmp_path / "encoder")
    frozen = {key: value.clone() for key, value in artifact.encoder.state_dict().items()}
    learned = train_downstream(
        FIXED, artifact, run_dir=tmp_path / "run", env_steps=25, random_agent_steps=5, batch_size=8,
        replay_capacity=25, queue_size=16, hidden_dim=16, eval_interval_env_steps=25, eval_episodes=2,
        precision="fp32", progress=False,
    )  # fmt: skip
    assert learned.env_steps == 25  # 20 of them with an update
    assert [row["updates"] for row in learned.evaluations][-1] == 20
    agent, _ = load_agent(tmp_path / "run" / "agent")
    for key, value in frozen.items():
        assert torch.equal(agent.encoder.state_dict()[key], value), key
    episodes = evaluate(agent, make_env(FIXED, seed=0, image_size=12), episodes=2, progress=False)
    assert [episode.agent_steps for episode in episodes] == [10, 10]

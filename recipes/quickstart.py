"""CRPTpro at small scale: collect at random, pre-train, freeze, learn a task, beside two controls.

    python recipes/quickstart.py                    # two CPU cores suffice; no GPU, no display
    python recipes/quickstart.py --out runs/other --seed 1

The controls are the same agent on an untrained encoder, and the uniform random policy; all three are evaluated on the
same episodes. Writes OUT/report/index.html. Needs 0.6 GB of disk and 4 GB of memory. If killed, the same command
resumes.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from crptpro.artifact import write_json
from crptpro.console import parse, run_main
from crptpro.data import collect_group
from crptpro.domains import get_domain
from crptpro.envs import make_env
from crptpro.experiments.report import build_report
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import random_pretrained, save_pretrained
from crptpro.seeding import derive_seed, seed_everything
from crptpro.training import (
    DownstreamConfig,
    PretrainConfig,
    evaluate,
    pretrain,
    summarize,
    train_downstream,
    uniform_policy,
)

logger = logging.getLogger("crptpro.quickstart")
ENCODER = {"channels": (16, 16, 16, 16), "strides": (2, 2, 1, 1)}  # 4,096 features, the paper's encoder has 39,200
PRETRAIN = PretrainConfig(updates=700, batch_size=128, learning_rate=3e-4, log_interval=20)
DOWNSTREAM = DownstreamConfig(env_steps=12_000, eval_interval_env_steps=12_000, batch_size=128, learning_rate=1e-3,
                              hidden_dim=256, replay_capacity=5_000, random_agent_steps=500)  # fmt: skip


@dataclass
class Config:
    """Every number of the small run; the paper's value is in brackets where it differs."""

    out: Path = Path("runs/quickstart")
    """everything is written below this directory"""
    task: str = "walker_stand"
    """task to learn on the frozen encoder; an easy one"""
    seed: int = 0
    """seeds every stage"""
    domains: tuple[str, ...] = ("walker", "cartpole", "finger")
    """domains the encoder is pre-trained on"""
    transitions: int = 2_000
    """random transitions per domain [100,000]"""
    workers: int = 2
    """collecting processes"""
    quality: Literal["exact", "fast"] = "fast"
    """render quality; fast uses smaller shadow maps, less than 1 % of the pixels differ [exact]"""
    action_repeat: int = 4
    """env steps per agent step; fewer renderings per episode than with the paper's [2]"""
    prototypes: int = 256
    """with more, batches of 128 would leave the exploration bonus mostly 0 [512]"""
    assignment_temperature: float = 0.05
    """of Sinkhorn-Knopp; with the paper's the loss stays on a plateau for over a thousand updates [0.1]"""
    pretrain: PretrainConfig = PRETRAIN
    """pre-training [50,000 updates of 512 transitions at 1e-4]"""
    downstream: DownstreamConfig = DOWNSTREAM
    """SAC on the frozen encoder [500,000 env steps, updates of 512 transitions at 1e-4, layers of 1,024]"""


def main(config: Config) -> None:
    """Run the stages; finished ones are skipped."""
    get_domain(config.task)  # an unknown name ends the recipe here
    env_settings = {"seed": config.seed, "quality": config.quality, "action_repeat": config.action_repeat}
    scores = {}

    logger.info("1/4 collect %d random transitions per domain", config.transitions)
    datasets = collect_group(
        config.domains, config.out / "data", transitions=config.transitions, workers=config.workers, **env_settings
    )

    logger.info("2/4 pre-train one encoder on all of them")
    seed_everything(config.seed)
    loss = ProtoLoss(
        PixelEncoder(**ENCODER), num_prototypes=config.prototypes, assignment_temperature=config.assignment_temperature
    )
    settings = replace(config.pretrain, seed=config.seed)
    result = pretrain(loss, datasets, run_dir=config.out / "pretrain", config=settings)
    encoder = save_pretrained(result, config.out / "encoder")

    logger.info("3/4 learn %s on the frozen encoder, and on an untrained one", config.task)
    untrained = random_pretrained(config.seed, **ENCODER)
    for name, pretrained in {"crptpro": encoder, "random-encoder": untrained}.items():
        run = train_downstream(
            config.task, pretrained, run_dir=config.out / name, config=replace(config.downstream, **env_settings)
        )
        last = [row["episode_return"] for row in run.evaluations if row["env_steps"] == run.env_steps]
        scores[name] = {"mean": sum(last) / len(last), "min": min(last), "max": max(last)}

    env = make_env(config.task, render=False, seed=config.seed, action_repeat=config.action_repeat)
    last_evaluation = derive_seed(config.seed, "evaluation", run.env_steps)  # the same episodes as the agents
    policy = uniform_policy(env, seed=config.seed)
    episodes = evaluate(policy, env, episodes=config.downstream.eval_episodes, seed=last_evaluation)
    scores["uniform random policy"] = summarize(episodes)
    env.close()
    write_json(config.out / "scores.json", scores)

    logger.info("4/4 report: %s", build_report(config.out))
    for name, score in scores.items():
        logger.info("%s: mean return %.0f (%.0f to %.0f)", name, score["mean"], score["min"], score["max"])


if __name__ == "__main__":
    run_main(lambda: main(parse(Config, __doc__)))

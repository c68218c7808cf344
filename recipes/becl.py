r"""BeCL: an agent with 16 skills seeks what tells them apart while one encoder learns the same; then SAC on each task.

    python recipes/becl.py --group A        # paper scale; needs a GPU
    python recipes/becl.py --group A --out runs/becl_ddpg --downstream.algorithm skill-ddpg \
        --downstream.random-agent-steps 2000                # its own agent on the tasks, instead of SAC

Numbers of Rooshy-yang/BeCL and of rll-research/url_benchmark, which it builds on; the batch size is that of the other
methods. Every update of the agent brings three of the encoder, 141,003 in all; with --explore.encoder-updates-each 1
they are 47,001, beside the 48,501 of APT and Proto-RL. Disk: 0.8 GB per domain and 1.3 GB per task. Killed at any
moment, the same command continues. Ends with one eval.csv per task under OUT, a row per episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from crptpro.console import run_main
from crptpro.domains import GROUPS, get_domain
from crptpro.loggers import RunLogger, WandbOptions
from crptpro.modules import PixelEncoder
from crptpro.objectives import get_method
from crptpro.pretrained import save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training import (
    ActiveConfig,
    DownstreamConfig,
    ExplorationSettings,
    SACSettings,
    pretrain_active,
    train_tasks,
)


@dataclass
class Config:
    """BeCL's hyper-parameters."""

    group: Literal["A", "B", "C", "D"] = "A"
    """domains to explore: A cheetah walker quadruped, B cartpole pendulum manipulation, C manipulation hopper finger,
    D walker pendulum hopper"""
    tasks: tuple[str, ...] = ()
    """tasks to learn; the group's own by default"""
    out: Path = Path("runs/becl")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""
    wandb: Literal["off", "auto", "offline", "online"] = "off"
    """mirror the records to Weights & Biases; auto is online when logged in, else offline"""

    # pre-training
    hidden_dim: int = 1024
    """width of the head on the convolutions"""
    temperature: float = 0.5
    """divides the cosines of the contrast"""
    pretrain_batch_size: int = 512
    """transitions per update of encoder and explorer"""
    pretrain_learning_rate: float = 1e-4
    """of the encoder's Adam"""
    explore: ExplorationSettings = field(
        default_factory=lambda: ExplorationSettings(
            env_steps=200_000,  # over all domains
            reward="skill-contrast",
            agent="skill-ddpg",
            skill_dim=16,
            skill_agent_steps=50,
            n_step=3,
            encoder_update_interval=2,
            encoder_updates_each=3,
            agent_update_interval=2,
            random_agent_steps=2_000,
            replay_capacity=100_000,
            agent_learning_rate=1e-4,
        )
    )
    """how it explores. The render quality here holds for the tasks too"""

    # downstream
    downstream: SACSettings = field(
        default_factory=lambda: SACSettings(replay_capacity=40_000, intrinsic_reward_coef=0.0)
    )
    """SAC on the frozen encoder, as for every other method, but without prototypes and their bonus; or, by algorithm
    skill-ddpg, the kind of agent that explored, with one skill"""


def main(config: Config) -> None:
    """Explore and pre-train, then learn; what is finished is found again."""
    seed_everything(config.seed)
    domains = GROUPS[config.group]
    tasks = config.tasks or [get_domain(domain).task for domain in domains]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    name = f"becl_group_{config.group}"
    wandb = None if config.wandb == "off" else WandbOptions(group=name, tags=("becl",), mode=config.wandb)

    loss = get_method("becl").build(
        PixelEncoder(pixel_offset=0.5),  # pixels in [-0.5, 0.5], which the artifact remembers
        skill_dim=config.explore.skill_dim,
        hidden_dim=config.hidden_dim,
        temperature=config.temperature,
    )
    run_dir = config.out / f"{name}_seed_{config.seed}"
    with RunLogger(run_dir, config=config, wandb=wandb) as logger:
        exploration = ActiveConfig(
            **vars(config.explore),
            batch_size=config.pretrain_batch_size,
            learning_rate=config.pretrain_learning_rate,
            seed=config.seed,
            precision=config.precision,
            device=config.device,
        )
        pretrain_active(loss, domains, config=exploration, run_dir=run_dir, logger=logger)
        encoder = save_pretrained(loss, run_dir / "encoder")
        logger.artifact(encoder, name=f"encoder_{run_dir.name}", kind="encoder")

    settings = DownstreamConfig(
        **vars(config.downstream),
        seed=config.seed,
        quality=config.explore.quality,
        precision=config.precision,
        device=config.device,
    )
    train_tasks(tasks, encoder, config.out, name=name, config=settings, wandb=wandb)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Config, description=__doc__)))

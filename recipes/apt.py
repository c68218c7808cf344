"""APT: an agent seeks what is far from all else it sees while one encoder learns by SimCLR; then SAC on each task.

    python recipes/apt.py --group A                        # APT(C): one encoder for a group; needs a GPU
    python recipes/apt.py --variant s --domain walker      # APT(S): an encoder for one domain

The paper says what APT is made of, its author's code is for Atari only, and so the numbers are those of the two where
they speak and of Proto-RL where they do not: temperature 0.07 and Adam 1e-4 from forhaoliu/mini_apt, the reward from
rll-research/url_benchmark. The exploring agent is SAC with DrQ's two views of each image. Disk: 0.8 GB per domain of a
group that is explored, 2.4 GB for a domain alone, and 1.3 GB per task. Killed at any moment, the same command
continues. Ends with one eval.csv per task under OUT, a row per episode.
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
    """APT's hyper-parameters."""

    variant: Literal["c", "s"] = "c"
    """c: one encoder for a group, 200,000 env steps over all its domains and 48,501 encoder updates; s: one encoder for
    one domain, 500,000 env steps and 124,500 encoder updates"""
    group: Literal["A", "B", "C", "D"] = "A"
    """of c: A cheetah walker quadruped, B cartpole pendulum manipulation, C manipulation hopper finger, D walker
    pendulum hopper"""
    domain: str = "walker"
    """of s"""
    tasks: tuple[str, ...] = ()
    """tasks to learn; those of the explored domains by default"""
    out: Path = Path("runs/apt")
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
    latent_dim: int = 128
    """length of the embeddings"""
    temperature: float = 0.07
    """divides the cosines of the contrast"""
    pretrain_batch_size: int = 512
    """transitions per update of encoder and explorer"""
    pretrain_learning_rate: float = 1e-4
    """of the encoder's Adam"""
    explore: ExplorationSettings = field(
        default_factory=lambda: ExplorationSettings(
            reward="particle",  # log(1 + mean distance to the k nearest in the batch / its running mean)
            knn_k=12,
            agent="averaged-sac",
            encoder_update_interval=2,
            agent_update_interval=1,
            random_agent_steps=1_000,
            replay_capacity=100_000,
            agent_learning_rate=1e-4,
        )
    )
    """how it explores; env_steps is the variant's. The render quality here holds for the tasks too"""

    # downstream
    downstream: SACSettings = field(
        default_factory=lambda: SACSettings(replay_capacity=40_000, intrinsic_reward_coef=0.0)
    )
    """SAC on the frozen encoder; without prototypes there is no exploration bonus"""


def main(config: Config) -> None:
    """Explore and pre-train, then learn; what is finished is found again."""
    seed_everything(config.seed)
    is_group = config.variant == "c"
    domains = GROUPS[config.group] if is_group else (config.domain,)
    tasks = config.tasks or [get_domain(domain).task for domain in domains]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    method = get_method(f"apt-{config.variant}")
    name = f"{method.name}_group_{config.group}" if is_group else f"{method.name}_{config.domain}"
    wandb = (
        None if config.wandb == "off" else WandbOptions(group=name, tags=(method.name,), mode=config.wandb)
    )

    loss = method.build(PixelEncoder(), latent_dim=config.latent_dim, temperature=config.temperature)
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

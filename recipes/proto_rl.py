"""Proto-RL: an agent seeks what its prototypes know little of while they and the encoder learn; then SAC on each task.

    python recipes/proto_rl.py --group A                       # Proto-RL(C): one encoder for a group; needs a GPU
    python recipes/proto_rl.py --variant s --domain walker     # Proto-RL(S): an encoder for one domain
    python recipes/proto_rl.py --group A --intr-loss-coef 5e-3 --out runs/proto_rl_intr    # ablation: with dispersion

Numbers of denisyarats/proto, and of CRPTpro's comparison with it. The exploring actor of Proto-RL(S) goes on in its own
domain's tasks. Disk: 0.8 GB per domain of a group that is explored, 2.4 GB for a domain alone, and a replay of 2.3 GB
per task. Killed at any moment, the same command continues. Ends with one eval.csv per task under OUT, a row per
episode.
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
    """Proto-RL's hyper-parameters."""

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
    out: Path = Path("runs/proto_rl")
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
    num_prototypes: int = 512
    """number of prototypes"""
    latent_dim: int = 128
    """length of prototypes and embeddings"""
    hidden_dim: int = 1024
    """width of the predictor (the released code: 512)"""
    temperature: float = 0.1
    """of predictions and assignments"""
    intr_loss_coef: float = 0.0
    """weight of the prototype dispersion: CRPTpro's idea; in the paper's ablations 5e-3 for (C), for (S) 1e-3 on
    cheetah and 5e-4 on hopper"""
    pretrain_batch_size: int = 512
    """transitions per update of encoder and explorer"""
    pretrain_learning_rate: float = 1e-4
    """of the encoder's Adam"""
    explore: ExplorationSettings = field(
        default_factory=lambda: ExplorationSettings(
            reward="prototype",  # distance to the k-th nearest candidate
            knn_k=3,
            queue_size=2_048,
            agent="rad-sac",
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
        default_factory=lambda: SACSettings(replay_capacity=100_000, intrinsic_reward_coef=0.2)
    )
    """SAC on the frozen encoder, with the prototypes' exploration bonus"""


def main(config: Config) -> None:
    """Explore and pre-train, then learn; what is finished is found again."""
    seed_everything(config.seed)
    is_group = config.variant == "c"
    domains = GROUPS[config.group] if is_group else (config.domain,)
    tasks = config.tasks or [get_domain(domain).task for domain in domains]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    method = get_method(f"proto-rl-{config.variant}")
    name = f"{method.name}_group_{config.group}" if is_group else f"{method.name}_{config.domain}"
    wandb = (
        None if config.wandb == "off" else WandbOptions(group=name, tags=(method.name,), mode=config.wandb)
    )

    loss = method.build(
        PixelEncoder(),
        num_prototypes=config.num_prototypes,
        latent_dim=config.latent_dim,
        hidden_dim=config.hidden_dim,
        temperature=config.temperature,
        intr_loss_coef=config.intr_loss_coef,
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
        result = pretrain_active(loss, domains, config=exploration, run_dir=run_dir, logger=logger)
        # Domains of a group have actions of their own each, so only the actor of one domain is handed over.
        actor = None if is_group else result.actors[get_domain(config.domain).name]
        encoder = save_pretrained(loss, run_dir / "encoder", actor=actor)
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

"""ATC for one group: augmented temporal contrast on the same random data, then SAC on each task of the group.

    python recipes/atc.py --group A                      # paper scale; needs a GPU
    python recipes/atc.py --group A --out runs/crptpro   # on the data that recipes/crptpro.py collected there

CRPTpro's comparison states ATC's budget (50,000 updates on the random data) and nothing else; loss, learning rate and
schedule are those of astooke/rlpyt: 1,000 updates of warm-up, then a cosine to 0, gradients clipped at norm 10. Disk:
2.1 GB per domain and 1.3 GB per task. Killed at any moment, the same command continues; another seed needs another
--out, as its random data are others. Ends with one eval.csv per task under OUT, a row per episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from crptpro.console import run_main
from crptpro.data import collect_group
from crptpro.domains import GROUPS, get_domain
from crptpro.loggers import RunLogger, WandbOptions
from crptpro.modules import PixelEncoder, usable_device
from crptpro.objectives import ATCLoss
from crptpro.pretrained import save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training import DownstreamConfig, SACSettings, pretrain, train_tasks


@dataclass
class Config:
    """ATC's hyper-parameters, with the budgets of the comparison."""

    group: Literal["A", "B", "C", "D"] = "A"
    """domains to pre-train on: A cheetah walker quadruped, B cartpole pendulum manipulation, C manipulation hopper
    finger, D walker pendulum hopper"""
    tasks: tuple[str, ...] = ()
    """tasks to learn; the group's own by default"""
    out: Path = Path("runs/atc")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""

    # data
    transitions: int = 100_000
    """random transitions per domain"""
    workers: int = 2
    """collecting processes"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""

    # pre-training
    updates: int = 50_000
    """encoder updates over all domains, one domain after the other"""
    pretrain_batch_size: int = 512
    """transitions per update; each is told from all others"""
    pretrain_learning_rate: float = 1e-3
    """of Adam, after the warm-up"""
    encoder_tau: float = 0.01
    """share of the encoder that enters its target at each update"""
    latent_dim: int = 128
    """length of the embeddings"""
    hidden_dim: int = 512
    """width of the anchors' perceptron"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""

    # logging
    wandb: Literal["off", "auto", "offline", "online"] = "off"
    """mirror the records to Weights & Biases; auto is online when logged in, else offline"""

    # downstream
    downstream: SACSettings = field(
        default_factory=lambda: SACSettings(replay_capacity=40_000, intrinsic_reward_coef=0.0)
    )
    """SAC on the frozen encoder; without prototypes there is no exploration bonus"""


def main(config: Config) -> None:
    """Collect, pre-train, learn; what is finished is found again."""
    seed_everything(config.seed)
    domains = GROUPS[config.group]
    tasks = config.tasks or [get_domain(domain).task for domain in domains]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    usable_device(config.device)
    name = f"atc_group_{config.group}"
    wandb = None if config.wandb == "off" else WandbOptions(group=name, tags=("atc",), mode=config.wandb)

    datasets = collect_group(
        domains,
        config.out / "data",
        transitions=config.transitions,
        seed=config.seed,
        workers=config.workers,
        quality=config.quality,
    )
    loss = ATCLoss(PixelEncoder(), latent_dim=config.latent_dim, hidden_dim=config.hidden_dim)
    run_dir = config.out / f"{name}_seed_{config.seed}"
    with RunLogger(run_dir, config=config, wandb=wandb) as logger:
        pretrain(
            loss,
            datasets,
            updates=config.updates,
            batch_size=config.pretrain_batch_size,
            learning_rate=config.pretrain_learning_rate,
            encoder_tau=config.encoder_tau,
            seed=config.seed,
            precision=config.precision,
            device=config.device,
            run_dir=run_dir,
            logger=logger,
        )
        encoder = save_pretrained(loss, run_dir / "encoder")
        logger.artifact(encoder, name=f"encoder_{run_dir.name}", kind="encoder")

    settings = DownstreamConfig(
        **vars(config.downstream),
        seed=config.seed,
        quality=config.quality,
        precision=config.precision,
        device=config.device,
    )
    train_tasks(tasks, encoder, config.out, name=name, config=settings, wandb=wandb)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Config, description=__doc__)))

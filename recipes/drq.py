"""DrQ: SAC from pixels that learns its encoder along with the task; what every pre-trained method is measured by.

    python recipes/drq.py                                      # every task of the paper at paper scale; needs a GPU
    python recipes/drq.py --tasks walker_run reach_duplo --device cuda --seed 1

Every default is the number of the paper's comparison or, where the paper is silent, of denisyarats/drq. Disk: a replay
of 2.3 GB per task. Killed at any moment, the same command continues. Ends with one eval.csv per task under OUT, a row
per episode, written by the very loop that trains on pre-trained encoders.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from crptpro.console import run_main
from crptpro.domains import TASKS, get_domain
from crptpro.loggers import WandbOptions
from crptpro.training import drq_settings, train_tasks


@dataclass
class DrQ:
    """DrQ's hyper-parameters."""

    env_steps: int = 1_000_000
    """budget in simulator steps: twice that of the pre-trained methods"""
    replay_capacity: int = 100_000
    """transitions kept"""
    random_agent_steps: int = 1_000
    """decisions taken uniformly at random before the first update; then one update per decision"""
    batch_size: int = 512
    """transitions per update"""
    learning_rate: float = 1e-3
    """of the three Adam optimisers: critic with encoder, actor, temperature"""
    discount: float = 0.99
    """per decision"""
    initial_temperature: float = 0.1
    """SAC's alpha at the start"""
    critic_tau: float = 0.01
    """share of critic and encoder that enters their targets at each target update"""
    actor_update_interval: int = 2
    """updates between two actor and temperature steps"""
    target_update_interval: int = 2
    """updates between two target updates"""
    shift_pad: int = 4
    """random shift of at most so many pixels; each observation is shifted twice (K = M = 2)"""
    bottleneck_dim: int = 50
    """width of the two heads on the convolutions, which end with a tanh"""
    hidden_dim: int = 1024
    """width of the two hidden layers of actor and critic"""
    eval_interval_env_steps: int = 10_000
    """simulator steps between two evaluations"""
    eval_episodes: int = 10
    """episodes per evaluation"""
    checkpoint_interval_env_steps: int = 5_000
    """simulator steps between two checkpoints"""
    log_interval_env_steps: int = 1_000
    """simulator steps between two rows of training metrics"""


@dataclass
class Config:
    """What to learn, where, and with which numbers."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """tasks to learn, one after the other"""
    out: Path = Path("runs/drq")
    """everything is written below this directory"""
    seed: int = 0
    """seeds everything"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""
    wandb: Literal["off", "auto", "offline", "online"] = "off"
    """mirror the records to Weights & Biases; auto is online when logged in, else offline"""
    drq: DrQ = field(default_factory=DrQ)
    """the method"""


def main(config: Config) -> None:
    """Learn every task; what is finished is found again."""
    for task in config.tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    wandb = None if config.wandb == "off" else WandbOptions(group="drq", mode=config.wandb)
    settings = drq_settings(
        **vars(config.drq),
        seed=config.seed,
        quality=config.quality,
        precision=config.precision,
        device=config.device,
    )
    # No artifact: the encoder starts from the seed.
    train_tasks(config.tasks, None, config.out, name="drq", config=settings, wandb=wandb)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Config, description=__doc__)))

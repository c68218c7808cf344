"""DrQ: SAC from pixels that trains its encoder on the task; the reference for every pre-trained method.

    python recipes/drq.py                                      # every task of the paper at paper scale; needs a GPU
    python recipes/drq.py --tasks walker_run reach_duplo --downstream.device cuda --seed 1

Every default is the number of the paper's comparison or, where the paper is silent, of denisyarats/drq. Disk: 2.6 GB
per task. If killed, the same command resumes. Writes one eval.csv per task below OUT, a row per episode. The
training loop is the one that pretrained encoders use.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from crptpro.console import parse, run_main
from crptpro.domains import TASKS, get_domain
from crptpro.seeding import derive_seed
from crptpro.training import DownstreamConfig, train_downstream


@dataclass
class Config:
    """What to learn, where, and with which numbers."""

    tasks: tuple[str, ...] = tuple(TASKS)
    """tasks to learn, one after the other"""
    out: Path = Path("runs/drq")
    """everything is written below this directory"""
    seed: int = 0
    """seeds everything"""
    downstream: DownstreamConfig = field(default_factory=DownstreamConfig)
    """all settings (default: DrQ's)"""


def main(config: Config) -> None:
    """Learn every task; finished ones are skipped."""
    for task in config.tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    for task in config.tasks:
        run_dir = config.out / f"{task}_drq_seed_{config.seed}"
        seed = derive_seed(config.seed, "task", task)
        train_downstream(task, "drq", run_dir=run_dir, config=replace(config.downstream, seed=seed))


if __name__ == "__main__":
    run_main(lambda: main(parse(Config, __doc__)))

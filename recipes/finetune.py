"""Fine-tune a pretrained encoder on one more domain, then learn that domain's task on it.

    python recipes/finetune.py runs/paper/crptpro_group_A_seed_0/encoder --domain pendulum

The paper's updates from the encoder of group A: pendulum 2,000, manipulation 2,000, cartpole 3,000, cheetah 1,000,
walker 500 (--pretrain.updates). Adam is reset; the target networks are kept. Disk: 2.1 GB for the domain's random data
and 1.3 GB for the task. Another seed needs another --out, because its random data differ.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from crptpro.console import parse, run_main
from crptpro.data import collect_random
from crptpro.domains import get_domain
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import DownstreamConfig, PretrainConfig, finetune, train_downstream


@dataclass
class Config:
    """Encoder, domain and task; the numbers of a stage are below --pretrain.* and --downstream.*."""

    pretrained: tyro.conf.Positional[str]
    """directory of the pretrained encoder; those that ship are slim, and cannot be trained further"""
    domain: str = "pendulum"
    """domain to fine-tune on"""
    task: str | None = None
    """downstream task (None: the domain's)"""
    out: Path = Path("runs/finetune")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    transitions: int = 100_000
    """random transitions to fine-tune on"""
    workers: int = 2
    """collecting processes"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""
    pretrain: PretrainConfig = field(default_factory=lambda: PretrainConfig(updates=2_000))
    """fine-tuning"""
    downstream: DownstreamConfig = field(default_factory=DownstreamConfig)
    """SAC on the frozen encoder"""


def main(config: Config) -> None:
    """Collect, fine-tune, learn; finished stages are skipped."""
    task = config.task or get_domain(config.domain).task
    get_domain(task)  # an unknown name ends the recipe here, not hours later
    pretrained = load_pretrained(config.pretrained)
    pretrained.build_loss()  # so does an artifact that cannot be trained further
    dataset = collect_random(
        config.domain,
        config.out / "data",
        transitions=config.transitions,
        seed=config.seed,
        workers=config.workers,
        quality=config.quality,
    )
    run_dir = config.out / f"finetune_{config.domain}"
    result = finetune(pretrained, dataset, run_dir=run_dir, config=replace(config.pretrain, seed=config.seed))
    encoder = save_pretrained(result, run_dir / "encoder")
    settings = replace(config.downstream, seed=config.seed, quality=config.quality)
    train_downstream(task, encoder, run_dir=config.out / task, config=settings)


if __name__ == "__main__":
    run_main(lambda: main(parse(Config, __doc__)))

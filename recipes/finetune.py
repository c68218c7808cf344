"""Fine-tune a pretrained encoder on one more domain, then learn that domain's task on it.

    python recipes/finetune.py runs/group_a/encoder --domain pendulum --updates 2000

The paper's budgets from the group A encoder: pendulum 2,000 updates, manipulation 2,000, cartpole 3,000,
cheetah 1,000, walker 500. The encoder gets better on that domain and worse on the others. Optimiser state starts
afresh; target networks are kept. Disk: 2.1 GB for the domain's random data and 1.3 GB for the task. Another seed needs
another --out, as its random data are others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from crptpro.console import run_main
from crptpro.data import collect_random
from crptpro.domains import get_domain
from crptpro.modules import usable_device
from crptpro.pretrained import finetune, load_pretrained, save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training import SACSettings, train_downstream


@dataclass
class Config:
    """The paper's numbers; the update budget depends on the domain."""

    pretrained: tyro.conf.Positional[Path]
    """directory of the pretrained encoder"""
    domain: str = "pendulum"
    """the one domain"""
    task: str | None = None
    """what is learned then (default: the domain's task)"""
    updates: int = 2_000
    """I_f: encoder updates"""
    transitions: int = 100_000
    """random transitions to fine-tune on"""
    batch_size: int = 512
    """transitions per update"""
    learning_rate: float = 1e-4
    """of Adam"""
    out: Path = Path("runs/finetune")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    workers: int = 2
    """collecting processes"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""
    downstream: SACSettings = field(default_factory=lambda: SACSettings(replay_capacity=40_000))
    """SAC on the frozen encoder"""


def main(config: Config) -> None:
    """Collect, fine-tune, learn; what is finished is found again."""
    task = config.task or get_domain(config.domain).task
    get_domain(task)  # what is wrong ends the recipe here, not hours later
    usable_device(config.device)
    pretrained = load_pretrained(config.pretrained)
    seed_everything(config.seed)
    dataset = collect_random(
        config.domain,
        config.out / "data",
        transitions=config.transitions,
        seed=config.seed,
        workers=config.workers,
        quality=config.quality,
    )
    run_dir = config.out / f"finetune_{config.domain}"
    loss, _ = finetune(
        pretrained,
        dataset,
        updates=config.updates,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        seed=config.seed,
        precision=config.precision,
        device=config.device,
        run_dir=run_dir,
    )
    encoder = save_pretrained(loss, run_dir / "encoder")
    train_downstream(
        task,
        encoder,
        run_dir=config.out / task,
        **vars(config.downstream),
        seed=config.seed,
        quality=config.quality,
        precision=config.precision,
        device=config.device,
    )


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Config, description=__doc__)))

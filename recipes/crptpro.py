"""The paper's pipeline for one group: collect, pre-train one encoder, then SAC on each task of the group.

    python recipes/crptpro.py --group A                       # paper scale; days on two cores, hours on a GPU
    python recipes/crptpro.py --group C --tasks walker_run    # an unseen task on group C's encoder
    python recipes/crptpro.py --group A --pretrained random-encoder    # the control: the same without pre-training

Every default is the paper's number. Disk: 2.1 GB per domain and 1.3 GB per task. Memory: 4 GB, or 20 GB where the
features of all random shifts are kept. Killed at any moment, the same command continues; another seed needs another
--out, as its random data are others. Ends with one eval.csv per task under OUT, a row per episode.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

if __name__ == "crptpro":
    # Running any script of this folder puts the folder first on the path, where this file's name hides the library.
    # Step aside: what is imported under this name from here on, and what the importer receives, is the library.
    sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != Path(__file__).resolve().parent]
    del sys.modules["crptpro"]

import tyro

from crptpro.console import run_main
from crptpro.data import collect_group
from crptpro.domains import GROUPS, get_domain
from crptpro.loggers import RunLogger, WandbOptions
from crptpro.modules import PixelEncoder, usable_device
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import load_pretrained, random_pretrained, save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training import DownstreamConfig, SACSettings, pretrain, train_tasks


@dataclass
class Config:
    """The hyper-parameter table of the paper."""

    group: Literal["A", "B", "C", "D"] = "A"
    """domains to pre-train on: A cheetah walker quadruped, B cartpole pendulum manipulation, C manipulation hopper
    finger, D walker pendulum hopper"""
    tasks: tuple[str, ...] = ()
    """tasks to learn; the group's own by default"""
    out: Path = Path("runs/crptpro")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    pretrained: Literal["crptpro", "random-encoder"] = "crptpro"
    """the random encoder is the control that the paper lacks"""

    # data
    transitions: int = 100_000
    """b: random transitions per domain"""
    workers: int = 2
    """collecting processes"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""

    # pre-training
    updates: int = 50_000
    """I_p: encoder updates over all domains, one domain after the other"""
    pretrain_batch_size: int = 512
    """transitions per update"""
    pretrain_learning_rate: float = 1e-4
    """of Adam"""
    encoder_tau: float = 0.05
    """eta: share of the encoder that enters its target at each update"""
    num_prototypes: int = 512
    """M"""
    latent_dim: int = 128
    """length of prototypes and embeddings"""
    hidden_dim: int = 1024
    """width of the predictor"""
    temperature: float = 0.1
    """tau, of predictions, and of assignments unless they have their own"""
    assignment_temperature: float | None = None
    """of assignments; 0.05 leaves the loss's first plateau about twice as soon, for small budgets; None: the same"""
    intr_loss_coef: float = 5e-3
    """alpha: weight of the prototype dispersion"""
    offset: float = 1.5
    """w: offset in its denominator"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""

    # logging
    wandb: Literal["off", "auto", "offline", "online"] = "off"
    """mirror the records to Weights & Biases; auto is online when logged in, else offline"""

    # downstream
    downstream: SACSettings = field(default_factory=lambda: SACSettings(replay_capacity=40_000))
    """SAC on the frozen encoder"""


def main(config: Config) -> None:
    """Run the three stages; what is finished is found again."""
    seed_everything(config.seed)
    out = config.out
    domains = GROUPS[config.group]
    tasks = config.tasks or [get_domain(domain).task for domain in domains]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    usable_device(config.device)
    wandb = None
    if config.wandb != "off":
        wandb = WandbOptions(group=f"group_{config.group}", tags=(config.pretrained,), mode=config.wandb)

    if config.pretrained == "random-encoder":
        pretrained = random_pretrained(seed=config.seed)
    else:
        datasets = collect_group(
            domains,
            out / "data",
            transitions=config.transitions,
            seed=config.seed,
            workers=config.workers,
            quality=config.quality,
        )
        encoder = PixelEncoder()
        loss = ProtoLoss(
            encoder,
            num_prototypes=config.num_prototypes,
            latent_dim=config.latent_dim,
            hidden_dim=config.hidden_dim,
            temperature=config.temperature,
            assignment_temperature=config.assignment_temperature,
            intr_loss_coef=config.intr_loss_coef,
            offset=config.offset,
        )
        run_dir = out / f"group_{config.group}_seed_{config.seed}"
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
            path = save_pretrained(loss, run_dir / "encoder")
            logger.artifact(path, name=f"encoder_{run_dir.name}", kind="encoder")
        pretrained = load_pretrained(path)

    train_tasks(
        tasks,
        pretrained,
        out,
        name="random-encoder" if config.pretrained == "random-encoder" else f"group_{config.group}",
        config=DownstreamConfig(
            **vars(config.downstream),
            seed=config.seed,
            quality=config.quality,
            precision=config.precision,
            device=config.device,
        ),
        wandb=wandb,
    )


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Config, description=__doc__)))

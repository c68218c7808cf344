"""The ``crptpro`` command: a thin, typed shell over the library's functions."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg, subcommand

from crptpro.cli.evaluate import Evaluate, Quality
from crptpro.cli.request import Logging, expand_groups, image_format, require_device
from crptpro.console import run_main
from crptpro.domains import get_domain
from crptpro.downstream_config import DownstreamConfig
from crptpro.seeding import seed_everything

logger = logging.getLogger(__name__)

Precision = Literal["auto", "fp32", "bf16"]
RANDOM_ENCODER = "random-encoder"


@dataclass(frozen=True)
class Doctor:
    """Check that this machine can run crptpro: render every domain, print versions, say what to fix."""

    domains: tuple[str, ...] = ()
    """only these domains (default: the paper's eight)"""

    def run(self) -> None:
        """Print the report; exit status 1 unless a run would work."""
        from crptpro.doctor import run_doctor

        report = run_doctor(domains=self.domains or None)
        print(report.text())
        if not report.ok:
            raise SystemExit(1)


@dataclass(frozen=True)
class Collect:
    """Let a uniform random policy fill one dataset per domain."""

    domains: Positional[tuple[str, ...]]
    """domains, tasks, or group letters, e.g. `walker cartpole`, `A`, `gymnasium:HalfCheetah-v5`"""
    out: Path = Path("data")
    """one directory per domain is made below this one"""
    transitions: int = 100_000
    """transitions per domain (21 KB each)"""
    seed: int = 0
    """the same seed gives the same data whatever the number of workers"""
    workers: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    """collecting processes, shared by all domains (default: one per core)"""
    quality: Quality = "exact"
    """render quality; fast uses smaller shadow maps on software GL"""

    def run(self) -> None:
        """Collect, or continue collecting."""
        from crptpro.data import collect_group

        paths = collect_group(
            expand_groups(self.domains),
            self.out,
            transitions=self.transitions,
            seed=self.seed,
            workers=self.workers,
            quality=self.quality,
        )
        for name, path in paths.items():
            logger.info("%s: %s", name, path)


@dataclass(frozen=True)
class Pretrain:
    """Pre-train one encoder on the datasets of several domains, one update per domain in turn."""

    datasets: Positional[tuple[Path, ...]]
    """dataset directories, e.g. data/walker data/cartpole"""
    out: Annotated[Path, arg(name="out")]
    """run directory: records and checkpoints, and the pretrained encoder in OUT/encoder"""
    method: str = "crptpro"
    """a registered method, e.g. crptpro or released-code"""
    updates: int | None = None
    """encoder updates over all domains (default: the method's, 50,000)"""
    batch_size: int | None = None
    """transitions per update (default: the method's, 512)"""
    learning_rate: float | None = None
    """of Adam (default: the method's, 1e-4)"""
    assignment_temperature: float | None = None
    """temperature of the Sinkhorn-Knopp targets (default: the student's, 0.1)"""
    intr_loss_coef: float | None = None
    """weight of the prototype dispersion loss (default: the method's, 5e-3)"""
    seed: int = 0
    """seeds initialisation, sampling and shifts"""
    precision: Precision = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""
    checkpoint_interval: int = 500
    """updates between two checkpoints"""
    log_interval: int = 50
    """updates between two rows of the record"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def run(self) -> None:
        """Pre-train, or continue, and write the artifact."""
        from crptpro.modules import PixelEncoder
        from crptpro.objectives import get_method
        from crptpro.pretrained import save_pretrained
        from crptpro.training import pretrain

        # Whatever is wrong with the request is found before the run directory is made.
        require_device(self.device)
        image_size, frame_stack = image_format(self.datasets)
        options = {
            name: value
            for name in ("assignment_temperature", "intr_loss_coef")
            if (value := getattr(self, name)) is not None
        }
        seed_everything(self.seed)
        loss = get_method(self.method).build(PixelEncoder(3 * frame_stack, image_size=image_size), **options)
        with self.logging.open(self.out, self) as records:
            pretrain(
                loss,
                list(self.datasets),
                updates=self.updates,
                batch_size=self.batch_size,
                learning_rate=self.learning_rate,
                seed=self.seed,
                precision=self.precision,
                device=self.device,
                run_dir=self.out,
                logger=records,
                checkpoint_interval=self.checkpoint_interval,
                log_interval=self.log_interval,
            )
            logger.info("pretrained encoder: %s", save_pretrained(loss, self.out / "encoder"))


@dataclass(frozen=True)
class Finetune:
    """Continue pre-training on one domain from a pretrained encoder."""

    pretrained: Positional[Path]
    """directory of the pretrained encoder"""
    dataset: Positional[Path]
    """dataset directory of the one domain"""
    out: Path
    """run directory; the new encoder goes to OUT/encoder"""
    updates: int = 2_000
    """encoder updates (the paper: pendulum 2,000, manipulation 2,000, cartpole 3,000, cheetah 1,000, walker 500)"""
    batch_size: int | None = None
    """transitions per update (default: the method's)"""
    learning_rate: float | None = None
    """of Adam (default: the method's)"""
    seed: int = 0
    """seeds sampling and shifts"""
    precision: Precision = "auto"
    """arithmetic of the convolutions and big matrix products"""
    device: str = "cpu"
    """where to train"""
    checkpoint_interval: int = 500
    """updates between two checkpoints"""
    log_interval: int = 50
    """updates between two rows of the record"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def run(self) -> None:
        """Fine-tune, or continue, and write the artifact."""
        from crptpro.pretrained import finetune, load_pretrained, save_pretrained

        require_device(self.device)
        image_size, frame_stack = image_format([self.dataset])
        pretrained = load_pretrained(
            self.pretrained, expect={"image_size": image_size, "frame_stack": frame_stack}
        )
        seed_everything(self.seed)
        with self.logging.open(self.out, self) as records:
            loss, _ = finetune(
                pretrained,
                self.dataset,
                updates=self.updates,
                batch_size=self.batch_size,
                learning_rate=self.learning_rate,
                seed=self.seed,
                precision=self.precision,
                device=self.device,
                run_dir=self.out,
                logger=records,
                checkpoint_interval=self.checkpoint_interval,
                log_interval=self.log_interval,
            )
            logger.info("fine-tuned encoder: %s", save_pretrained(loss, self.out / "encoder"))


@dataclass(frozen=True)
class Downstream:
    """Train SAC on a frozen encoder with the prototype-kNN exploration bonus."""

    task: Positional[str]
    """task to learn, e.g. walker_run, reach_duplo, gymnasium:HalfCheetah-v5"""
    pretrained: str
    """directory of the pretrained encoder, or `random-encoder` for the untrained control"""
    out: Path
    """run directory: eval.csv, train.csv, checkpoints, and the agent in OUT/agent"""
    config: Annotated[DownstreamConfig, arg(name="")] = field(default_factory=DownstreamConfig)
    """every number of the stage"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def run(self) -> None:
        """Train, or continue."""
        from crptpro.pretrained import load_pretrained, random_pretrained
        from crptpro.training import train_downstream

        require_device(self.config.device)
        get_domain(self.task)  # an unknown name is refused before the run directory is made
        if self.pretrained == RANDOM_ENCODER:
            artifact = random_pretrained(seed=self.config.seed)
        else:
            artifact = load_pretrained(self.pretrained)
        with self.logging.open(self.out, self) as records:
            result = train_downstream(
                self.task, artifact, run_dir=self.out, config=self.config, logger=records
            )
        logger.info("agent: %s", result.agent_path)


def main() -> None:
    """Entry point of the ``crptpro`` command."""
    commands = tyro.conf.OmitSubcommandPrefixes[
        Annotated[Doctor, subcommand("doctor")]
        | Annotated[Collect, subcommand("collect")]
        | Annotated[Pretrain, subcommand("pretrain")]
        | Annotated[Finetune, subcommand("finetune")]
        | Annotated[Downstream, subcommand("downstream")]
        | Annotated[Evaluate, subcommand("evaluate")]
    ]
    run_main(lambda: tyro.cli(commands, prog="crptpro", description=DESCRIPTION).run())


DESCRIPTION = """Cross-domain random pre-training with prototypes for reinforcement learning from pixels.
Start with `crptpro doctor`, then collect, pretrain and downstream; each stage continues where it was killed."""

"""``crptpro pretrain`` and ``crptpro finetune``: train an encoder on datasets and keep it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from crptpro.cli.request import Logging, image_format, require_device
from crptpro.loggers import RunLogger
from crptpro.seeding import seed_everything

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PretrainingOptions:
    """What both commands ask."""

    out: Path
    """run directory: records and checkpoints, and the encoder in OUT/encoder"""
    batch_size: int | None = None
    """transitions per update (default: the method's; crptpro 512)"""
    learning_rate: float | None = None
    """of Adam (default: the method's; crptpro 1e-4)"""
    seed: int = 0
    """seeds initialisation, sampling and shifts"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products"""
    compile: Literal["auto", "on", "off"] = "auto"
    """compile the loss with torch.compile; changes rounding only (auto: on a GPU)"""
    cuda_graph: Literal["auto", "on", "off"] = "auto"
    """record the update once and replay it (auto: on a GPU)"""
    device: str = "cpu"
    """where to train"""
    checkpoint_interval: int = 500
    """updates between two checkpoints"""
    log_interval: int = 50
    """updates between two rows of the record"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def training_arguments(self) -> dict[str, Any]:
        """Return the keywords that `pretrain` and `finetune` share."""
        names = (
            "batch_size", "learning_rate", "seed", "precision", "compile", "cuda_graph", "device",
            "checkpoint_interval", "log_interval",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names} | {"run_dir": self.out}

    def keep(self, loss: Any, records: RunLogger) -> None:
        """Write the encoder, and copy it to the mirrors."""
        from crptpro.pretrained import save_pretrained

        path = save_pretrained(loss, self.out / "encoder")
        records.artifact(path, name=f"encoder_{self.out.name}", kind="encoder")
        logger.info("pretrained encoder: %s", path)


@dataclass(frozen=True, kw_only=True)
class Pretrain(PretrainingOptions):
    """Pre-train one encoder on the datasets of several domains, one update per domain in turn."""

    datasets: Positional[tuple[Path, ...]]
    """dataset directories, e.g. data/walker data/cartpole"""
    method: str = "crptpro"
    """a registered method, e.g. crptpro or released-code"""
    updates: int | None = None
    """encoder updates over all domains (default: the method's; crptpro 50,000)"""
    assignment_temperature: float | None = None
    """temperature of the Sinkhorn-Knopp targets (default: the student's, 0.1)"""
    intr_loss_coef: float | None = None
    """weight of the prototype dispersion loss (default: the method's, 5e-3)"""

    def run(self) -> None:
        """Pre-train, or continue, and write the artifact."""
        from crptpro.modules import PixelEncoder
        from crptpro.objectives import get_method
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
                loss, list(self.datasets), updates=self.updates, logger=records, **self.training_arguments()
            )
            self.keep(loss, records)


@dataclass(frozen=True, kw_only=True)
class Finetune(PretrainingOptions):
    """Continue pre-training on one domain from a pretrained encoder."""

    pretrained: Positional[Path]
    """directory of the pretrained encoder"""
    dataset: Positional[Path]
    """dataset directory of the one domain"""
    updates: int = 2_000
    """encoder updates (the paper: pendulum 2,000, manipulation 2,000, cartpole 3,000, cheetah 1,000, walker 500)"""

    def run(self) -> None:
        """Fine-tune, or continue, and write the artifact."""
        from crptpro.pretrained import finetune, load_pretrained

        require_device(self.device)
        image_size, frame_stack = image_format([self.dataset])
        pretrained = load_pretrained(
            self.pretrained, expect={"image_size": image_size, "frame_stack": frame_stack}
        )
        seed_everything(self.seed)
        with self.logging.open(self.out, self) as records:
            loss, _ = finetune(
                pretrained, self.dataset, updates=self.updates, logger=records, **self.training_arguments()
            )
            self.keep(loss, records)

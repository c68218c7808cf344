"""``crptpro pretrain`` and ``crptpro finetune``: train an encoder on datasets and keep it."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from crptpro.active_config import ExplorationSettings
from crptpro.cli.request import Logging, explored_domains, image_format
from crptpro.errors import CRPTproError
from crptpro.loggers import RunLogger
from crptpro.seeding import seed_everything
from crptpro.switches import Switch

if TYPE_CHECKING:
    from torch import nn
    from torchrl.objectives import LossModule

    from crptpro.objectives import ExplorationDefaults, Method

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
    """arithmetic of the convolutions and big matrix products (auto: bf16 where the hardware is faster in it)"""
    channels_last: Switch = "auto"
    """memory layout of the convolutions; changes rounding only (auto: on)"""
    compile: Switch = "auto"
    """compile the loss with torch.compile; changes rounding only (auto: off)"""
    cuda_graph: Switch = "auto"
    """on a GPU, record the update once and replay it (auto: off)"""
    device: str = "cpu"
    """where to train"""
    checkpoint_interval: int = 500
    """updates between two checkpoints (exploring methods: --explore.checkpoint-interval-env-steps instead)"""
    log_interval: int = 50
    """updates between two rows of the record"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def training_arguments(self) -> dict[str, Any]:
        """Return the keywords that `pretrain` and `finetune` share."""
        names = (
            "batch_size", "learning_rate", "seed", "precision", "channels_last", "compile", "cuda_graph", "device",
            "checkpoint_interval", "log_interval",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names} | {"run_dir": self.out}

    def keep(self, loss: LossModule, records: RunLogger, *, actor: nn.Module | None = None) -> None:
        """Write the encoder, and copy it to the mirrors."""
        from crptpro.pretrained import save_pretrained

        path = save_pretrained(loss, self.out / "encoder", actor=actor)
        records.artifact(path, name=f"encoder_{self.out.name}", kind="encoder")
        logger.info("pretrained encoder: %s", path)


@dataclass(frozen=True, kw_only=True)
class Pretrain(PretrainingOptions):
    """Pre-train one encoder for several domains, one update per domain in turn: on datasets, or while exploring."""

    sources: Annotated[Positional[tuple[str, ...]], arg(help_behavior_hint="(required)")]
    """dataset directories, e.g. data/walker data/cartpole; for exploring methods domains, tasks or group letters"""
    method: str = "crptpro"
    """a registered method: crptpro, atc (on datasets), proto-rl-c, proto-rl-s, apt-c, apt-s, becl (exploring), a preset
    such as crptpro-fast, or one of your own with --plugin FILE.py"""
    updates: int | None = None
    """encoder updates over all domains (default: the method's; crptpro 50,000); for exploring methods
    --explore.env-steps instead"""
    assignment_temperature: float | None = None
    """temperature of the Sinkhorn-Knopp targets (default: the student's, 0.1)"""
    annealing_updates: int | None = None
    """move the targets' temperature from --assignment-temperature to the student's over so many updates (default: leave
    it)"""
    intr_loss_coef: float | None = None
    """weight of the prototype dispersion loss (default: the method's; crptpro 5e-3, proto-rl 0)"""
    domain_schedule: Literal["cycle", "random", "mixed"] = "cycle"
    """whose rows an update on datasets takes: one domain's after the other's, a random domain's, or all domains'"""
    explore: ExplorationSettings = field(default_factory=ExplorationSettings)
    """how a method explores that does"""

    def run(self) -> None:
        """Pre-train, or continue, and write the artifact."""
        from crptpro.modules import usable_device
        from crptpro.objectives import get_method

        # Whatever is wrong with the request is found before the run directory is made.
        usable_device(self.device)
        method = get_method(self.method)
        if method.exploration is None:
            self._on_datasets(method)
        else:
            self._exploring(method, method.exploration)

    def _on_datasets(self, method: Method) -> None:
        from crptpro.training import pretrain

        if self.explore != ExplorationSettings():
            raise CRPTproError(
                f"{self.method} learns from datasets and does not explore; leave --explore.* out."
            )
        datasets = [Path(source) for source in self.sources]
        loss = self._build(method, *image_format(datasets))
        with self.logging.open(self.out, self) as records:
            pretrain(
                loss,
                datasets,
                updates=self.updates,
                domain_schedule=self.domain_schedule,
                logger=records,
                **self.training_arguments(),
            )
            self.keep(loss, records)

    def _exploring(self, method: Method, exploration: ExplorationDefaults) -> None:
        from crptpro.training import ActiveConfig, pretrain_active
        from crptpro.training.explore import require_explorable

        domains = explored_domains(self.sources, method.name)
        self._refuse_what_datasets_need()
        loss = self._build(method)
        config = ActiveConfig(
            **vars(self.explore),
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
            log_interval=self.log_interval,
            seed=self.seed,
            precision=self.precision,
            channels_last=self.channels_last,
            device=self.device,
        )
        require_explorable(loss, domains, config)
        with self.logging.open(self.out, self) as records:
            result = pretrain_active(loss, domains, run_dir=self.out, config=config, logger=records)
            actor = next(iter(result.actors.values())) if exploration.transfers_actor else None
            self.keep(loss, records, actor=actor)

    def _refuse_what_datasets_need(self) -> None:
        if self.updates is not None:
            raise CRPTproError(
                f"{self.method} updates its encoder as it explores: its budget is --explore.env-steps, not --updates."
            )
        instead = {
            "checkpoint_interval": "use --explore.checkpoint-interval-env-steps",
            "compile": "leave it out",
            "domain_schedule": "leave it out",
            "cuda_graph": "leave it out",
        }
        for option in dataclasses.fields(self):
            if option.name in instead and getattr(self, option.name) != option.default:
                flag = f"--{option.name.replace('_', '-')}"
                raise CRPTproError(f"{flag} is for methods that learn from datasets; {instead[option.name]}.")

    def _build(self, method: Method, image_size: int = 84, frame_stack: int = 3) -> LossModule:
        options = {
            name: value
            for name in ("assignment_temperature", "annealing_updates", "intr_loss_coef")
            if (value := getattr(self, name)) is not None
        }
        if method.exploration is not None and method.exploration.skill_dim and self.explore.skill_dim:
            options["skill_dim"] = self.explore.skill_dim  # the head has one output per skill
        seed_everything(self.seed)
        return method.build(method.build_encoder(3 * frame_stack, image_size), **options)


@dataclass(frozen=True, kw_only=True)
class Finetune(PretrainingOptions):
    """Continue pre-training on one domain from a pretrained encoder."""

    pretrained: Positional[Path]
    """directory of the pretrained encoder"""
    dataset: Positional[Path]
    """dataset directory of the one domain"""
    updates: int = 2_000
    """encoder updates (the paper: pendulum 2,000, manipulation 2,000, cartpole 3,000, cheetah 1,000, walker 500)"""
    optimizer_state_from: Path | None = None
    """run directory of the pre-training, to go on with its Adam moments (default: a fresh Adam)"""

    def run(self) -> None:
        """Fine-tune, or continue, and write the artifact."""
        from crptpro.modules import usable_device
        from crptpro.pretrained import finetune, load_pretrained

        usable_device(self.device)
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
                optimizer_state_from=self.optimizer_state_from,
                logger=records,
                **self.training_arguments(),
            )
            self.keep(loss, records)

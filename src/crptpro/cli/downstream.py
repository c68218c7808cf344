"""``crptpro downstream`` and ``crptpro drq``: reinforcement learning on a frozen encoder, and end to end."""

from __future__ import annotations

import itertools
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, Suppress, arg

from crptpro.cli.request import Logging
from crptpro.domains import get_domain
from crptpro.downstream_config import (
    Algorithm,
    DownstreamConfig,
    SkillDDPGSettings,
    drq_settings,
    skill_ddpg_settings,
)
from crptpro.errors import CRPTproError

logger = logging.getLogger(__name__)

RANDOM_ENCODER = "random-encoder"


def settings_asked_for(arguments: Sequence[str]) -> DownstreamConfig:
    """Return the settings that a command line starts from: those of the algorithm it names.

    So ``crptpro downstream --algorithm skill-ddpg --help`` shows that algorithm's numbers, and each may be changed.

    Args:
        arguments: of the command; what cannot be read is left to the parser.
    """
    words = " ".join(arguments).replace("=", " ").split()
    named = [after for word, after in itertools.pairwise(words) if word == "--algorithm"]
    # DrQ's, too: what is refused then is DrQ itself, not settings that it does not read.
    of = {"skill-ddpg": skill_ddpg_settings, "drq": drq_settings}
    return of.get(named[-1] if named else "", DownstreamConfig)()


@dataclass(frozen=True)
class Downstream:
    """Train SAC on a frozen encoder with the prototype-kNN exploration bonus, or BeCL's own agent on one."""

    task: Positional[str]
    """task to learn, e.g. walker_run, reach_duplo, gymnasium:HalfCheetah-v5"""
    pretrained: str
    """directory of the pretrained encoder, or `random-encoder` for the untrained control"""
    out: Path
    """run directory: eval.csv, train.csv, checkpoints, and the agent in OUT/agent"""
    config: Annotated[DownstreamConfig, arg(name="")] = field(
        default_factory=lambda: settings_asked_for(sys.argv)
    )
    """every number of the stage"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def run(self) -> None:
        """Train, or continue."""
        from crptpro.modules import usable_device
        from crptpro.pretrained import load_pretrained, random_pretrained
        from crptpro.training import train_downstream

        if self.config.algorithm == "drq":
            raise CRPTproError(
                f"DrQ trains its encoder itself: crptpro drq {self.task} --out {self.out}, without --pretrained."
            )
        usable_device(self.config.device)
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


@dataclass(frozen=True)
class DrQConfig(DownstreamConfig):
    """DrQ's settings, without options for what it has no use for: a pretrained encoder, a bonus, BeCL's agent."""

    algorithm: Suppress[Algorithm] = "drq"
    replay_capacity: int | None = None
    """transitions kept; the oldest go first"""
    random_agent_steps: int = 1_000
    """decisions taken uniformly at random before the first update"""
    transfer_actor: Suppress[bool | None] = None
    initial_temperature: float = 0.1
    """SAC's alpha at the start"""
    actor_update_interval: int = 2
    """updates between two actor and temperature steps"""
    target_update_interval: int = 2
    """updates between two target updates"""
    intrinsic_reward_coef: Suppress[float] = 0.0
    knn_k: Suppress[int] = 3
    queue_size: Suppress[int] = 2_048
    reset_queue: Suppress[bool] = False
    features: Suppress[Literal["auto", "dense", "reencode"]] = "auto"
    dense_precision: Suppress[Literal["auto", "bf16"]] = "auto"
    skill_ddpg: Suppress[SkillDDPGSettings] = field(default_factory=SkillDDPGSettings)


@dataclass(frozen=True)
class DrQ:
    """Train DrQ, SAC that learns its encoder along with the task: the reference without pre-training."""

    task: Positional[str]
    """task to learn, e.g. walker_run, reach_duplo, gymnasium:HalfCheetah-v5"""
    out: Path
    """run directory: eval.csv, train.csv, checkpoints, and the agent in OUT/agent"""
    config: Annotated[DrQConfig, arg(name="")] = field(
        default_factory=lambda: DrQConfig(**vars(drq_settings()))
    )
    """every number of the run"""
    logging: Logging = field(default_factory=Logging)
    """mirrors"""

    def run(self) -> None:
        """Train, or continue."""
        from crptpro.modules import usable_device
        from crptpro.training import train_downstream

        usable_device(self.config.device)
        get_domain(self.task)  # an unknown name is refused before the run directory is made
        with self.logging.open(self.out, self) as records:
            config = DownstreamConfig(**vars(self.config))
            result = train_downstream(self.task, None, run_dir=self.out, config=config, logger=records)
        logger.info("agent: %s", result.agent_path)

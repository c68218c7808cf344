"""What a description amounts to: how much training, with which settings."""

from __future__ import annotations

from typing import Any, NamedTuple

from crptpro.active_config import ActiveConfig
from crptpro.downstream_config import DownstreamConfig, drq_settings, skill_ddpg_settings
from crptpro.experiments.pieces import EncoderPiece, ExploredPiece, FinetunedPiece, PretrainedPiece, RunPiece
from crptpro.objectives import ExplorationDefaults, get_method
from crptpro.seeding import derive_seed
from crptpro.training.action_repeat import action_repeat_of
from crptpro.training.explore.plan import Plan, make_plan, resolve


class Budget(NamedTuple):
    """What training takes.

    Args:
        updates: of the encoder, over all domains.
        decisions: of exploring agents, over all domains; 0 for a method on datasets.
    """

    updates: int
    decisions: int


def budget(encoder: EncoderPiece) -> Budget:
    """Return the updates and decisions of an encoder's own training, without those of one that it started from.

    Raises:
        CRPTproError: for an exploration that would end before its first update.
    """
    if isinstance(encoder, ExploredPiece):
        plan = exploration_plan(encoder)
        return Budget(plan.encoder_updates, plan.decisions)
    trained = isinstance(encoder, (PretrainedPiece, FinetunedPiece))
    return Budget(encoder.updates if trained else 0, 0)  # type: ignore[attr-defined]


def exploration_config(encoder: ExploredPiece) -> ActiveConfig:
    """Return an exploring encoder's settings with all that its method decides."""
    method = get_method(encoder.method)
    config = ActiveConfig(**dict(encoder.explore), seed=encoder.seed)
    return resolve(config, method.exploration or ExplorationDefaults(), method.defaults)


def exploration_plan(encoder: ExploredPiece) -> Plan:
    """Return when an exploring encoder's agents decide, and which decisions come with updates."""
    config = exploration_config(encoder)
    return make_plan(config, [action_repeat_of(domain, config.action_repeat) for domain in encoder.domains])


def run_config(piece: RunPiece, **job: Any) -> DownstreamConfig:
    """Return a downstream run's settings on top of its algorithm's.

    Args:
        piece: the run.
        **job: settings that are no part of the piece: where and how it runs.
    """
    asked = dict(piece.config)
    algorithm = "drq" if piece.encoder is None else asked.get("algorithm")
    base = {"drq": drq_settings, "skill-ddpg": skill_ddpg_settings}.get(str(algorithm), DownstreamConfig)
    seed = derive_seed(piece.seed, "task", piece.task)
    return base(**asked, **job, seed=seed, colors=piece.colors)

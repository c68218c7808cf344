"""What a plan will cost: hours on this machine and bytes on its disk, before anything is made.

An estimate, and no more than that. Times are core-seconds as measured on one core of an AMD EPYC (Zen 4 with
AVX512-BF16), corrected by what finished pieces of the same kind took here.
"""

from __future__ import annotations

import functools
import heapq
import json
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crptpro.active_config import ActiveConfig
from crptpro.domains import get_domain
from crptpro.downstream_config import DownstreamConfig, drq_settings, skill_ddpg_settings
from crptpro.experiments.building import DONE, Store
from crptpro.experiments.pieces import (
    DatasetPiece,
    ExploredPiece,
    FinetunedPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    Settings,
    UntrainedPiece,
)
from crptpro.experiments.plan import Plan
from crptpro.objectives import ExplorationDefaults, get_method
from crptpro.training.action_repeat import action_repeat_of
from crptpro.training.explore.plan import Plan as ExplorationPlan
from crptpro.training.explore.plan import make_plan as make_exploration_plan
from crptpro.training.explore.plan import resolve

START_S = 10.0
"""Imports, the first picture, the first update."""
DECISION_S = {"quadruped": 0.06}
USUAL_DECISION_S = 0.03
"""One decision: the simulator, and a picture with exact pixels."""
ENCODER_ROW_S = 2.9e-3
"""An encoder update, for each row of its batch."""
ACT_S, EVALUATE_S = 0.05, 0.04
"""A decision of an agent: picture, features, action; while it learns, and while it is evaluated."""
AGENT_ROW_S, EXPLORER_ROW_S, DRQ_ROW_S = 0.5e-3, 1.25e-3, 2.5e-3
"""An agent's update for each row: on stored features, on pixels, on pixels with its encoder."""
PROBE_S = 60.0
USUAL_EPISODE_ENV_STEPS = 1_000

TRANSITION_BYTES = 21_200
"""A picture of 84 x 84 x 3 bytes, and no more than 32 bytes of rest."""
ENCODER_BYTES, AGENT_BYTES, OTHER_BYTES = 150_000_000, 120_000_000, 1_000_000
"""Encoder with its last checkpoint, two optimisers' moments included; likewise an agent; small records."""


@functools.singledispatch
def core_seconds(piece: Piece) -> float:
    """Estimate the seconds that a piece takes on one core of the reference machine.

    A kind without a way of its own is taken for a measurement of a minute.
    """
    return PROBE_S


@functools.singledispatch
def stored_bytes(piece: Piece) -> int:
    """Estimate the most that a piece occupies on disk."""
    return OTHER_BYTES


register_seconds: Callable[..., Any] = core_seconds.register
register_bytes: Callable[..., Any] = stored_bytes.register


@register_seconds
def _(piece: DatasetPiece) -> float:
    return START_S + piece.transitions * DECISION_S.get(piece.domain, USUAL_DECISION_S)


@register_bytes
def _(piece: DatasetPiece) -> int:
    return piece.transitions * TRANSITION_BYTES


@register_seconds
def _(piece: UntrainedPiece) -> float:
    return START_S


@register_bytes
def _(piece: UntrainedPiece) -> int:
    return ENCODER_BYTES // 4


@register_seconds
def _(piece: PretrainedPiece) -> float:
    return START_S + piece.updates * _batch_size(piece.method, piece.training) * ENCODER_ROW_S


@register_seconds
def _(piece: FinetunedPiece) -> float:
    return START_S + piece.updates * _batch_size(piece.base.method, piece.training) * ENCODER_ROW_S


@register_bytes
def _(piece: PretrainedPiece) -> int:
    return ENCODER_BYTES


@register_bytes
def _(piece: FinetunedPiece) -> int:
    return ENCODER_BYTES


@register_seconds
def _(piece: ExploredPiece) -> float:
    plan = _exploration(piece)[1]
    batch = _batch_size(piece.method, piece.explore)
    deciding = plan.decisions * (ACT_S + EXPLORER_ROW_S * batch / plan.agent_update_interval)
    return START_S + deciding + plan.encoder_updates * ENCODER_ROW_S * batch


@register_bytes
def _(piece: ExploredPiece) -> int:
    config, plan = _exploration(piece)
    kept = min(plan.agent_steps, config.replay_capacity or plan.agent_steps) * len(piece.domains)
    return kept * TRANSITION_BYTES + ENCODER_BYTES + AGENT_BYTES * len(piece.domains)


@register_seconds
def _(piece: RunPiece) -> float:
    config = _run_config(piece)
    decisions = config.env_steps / action_repeat_of(piece.task, config.action_repeat)
    row_s = DRQ_ROW_S if config.algorithm == "drq" else AGENT_ROW_S
    episode = get_domain(piece.task).episode_env_steps or USUAL_EPISODE_ENV_STEPS
    evaluations = config.env_steps // config.eval_interval_env_steps + 1
    evaluated = (
        evaluations * config.eval_episodes * episode / action_repeat_of(piece.task, config.action_repeat)
    )
    return START_S + decisions * (ACT_S + row_s * config.batch_size) + evaluated * EVALUATE_S


@register_bytes
def _(piece: RunPiece) -> int:
    config = _run_config(piece)
    replay = config.replay_capacity or 40_000
    decisions = -(-config.env_steps // action_repeat_of(piece.task, config.action_repeat))
    return min(replay, decisions) * TRANSITION_BYTES + AGENT_BYTES


def _batch_size(method: str, options: Settings) -> int:
    return dict(options).get("batch_size") or get_method(method).defaults.batch_size


def _exploration(piece: ExploredPiece) -> tuple[ActiveConfig, ExplorationPlan]:
    method = get_method(piece.method)
    asked = ActiveConfig(**dict(piece.explore))
    config = resolve(asked, method.exploration or ExplorationDefaults(), method.defaults)
    repeats = [action_repeat_of(domain, config.action_repeat) for domain in piece.domains]
    return config, make_exploration_plan(config, repeats)


def _run_config(piece: RunPiece) -> DownstreamConfig:
    asked = dict(piece.config)
    algorithm = "drq" if piece.encoder is None else str(asked.get("algorithm"))
    base = {"drq": drq_settings, "skill-ddpg": skill_ddpg_settings}.get(algorithm, DownstreamConfig)
    return base(**asked)


# --- what was learned here ----------------------------------------------------------------------------------------


def corrections(store: Store, device: str = "cpu") -> dict[str, float]:
    """Compare finished pieces with their estimates.

    Args:
        store: all of its pieces are looked at.
        device: only of jobs on this kind of device.

    Returns:
        Kind of piece to the median of measured by estimated seconds; kinds of which none is finished are missing.
    """
    found: dict[str, list[float]] = {}
    for path in sorted(store.root.glob(f"pieces/*/{DONE}")):
        try:
            done = json.loads(path.read_text())
            piece = store.described(path.parent.name)
            if str(done["job"]["device"]).split(":")[0] == device.split(":")[0]:
                found.setdefault(piece.kind, []).append(float(done["seconds"]) / core_seconds(piece))
        except Exception:  # of another version, or of a plugin that is not loaded: says nothing about costs
            continue
    return {kind: statistics.median(ratios) for kind, ratios in found.items()}


@dataclass(frozen=True)
class Cost:
    """What is still to be spent on a plan.

    Args:
        seconds: of each missing piece, by key.
        bytes: that are not on the disk yet, likewise.
        wall_seconds: until all are made.
        corrected: kinds whose estimate follows what was measured here.
    """

    seconds: Mapping[str, float]
    bytes: Mapping[str, int]
    wall_seconds: float
    corrected: frozenset[str]


def estimate(plan: Plan, store: Store, *, jobs: int, device: str = "cpu") -> Cost:
    """Estimate what the missing pieces of a plan cost.

    Args:
        plan: what is wanted.
        store: whose finished pieces correct the estimate.
        jobs: at a time.
        device: of networks.
    """
    ratios = corrections(store, device)
    seconds = {piece.key: core_seconds(piece) * ratios.get(piece.kind, 1.0) for piece in plan.missing}
    sizes = {piece.key: max(0, stored_bytes(piece) - _size(store.path(piece))) for piece in plan.missing}
    return Cost(seconds, sizes, wall_seconds(plan, seconds, jobs), frozenset(ratios))


def wall_seconds(plan: Plan, seconds: Mapping[str, float], jobs: int) -> float:
    """Play a plan through: each piece starts when its needs are there and one of ``jobs`` is free.

    Args:
        plan: what is wanted.
        seconds: of each missing piece, by key.
        jobs: at a time.
    """
    finished, waiting = set(plan.done), list(plan.missing)
    running: list[tuple[float, str]] = []
    now = 0.0
    while waiting or running:
        ready = [p for p in waiting if len(running) < jobs and all(n.key in finished for n in p.needs)]
        shared = [piece for piece in ready if not piece.is_exclusive]
        for piece in shared[: jobs - len(running)]:
            waiting.remove(piece)
            heapq.heappush(running, (now + seconds[piece.key], piece.key))
        if not running:  # only such as must be alone are left
            alone = ready[0]
            waiting.remove(alone)
            heapq.heappush(running, (now + seconds[alone.key], alone.key))
        now, key = heapq.heappop(running)
        finished.add(key)
    return now


def _size(directory: Path) -> int:
    return sum(path.stat().st_size for path in directory.rglob("*") if path.is_file())

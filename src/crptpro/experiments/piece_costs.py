"""What one piece costs: seconds on a core of the reference machine, and bytes on disk.

Times were measured on one core of an AMD EPYC (Zen 4 with AVX512-BF16). They are good enough to plan with and for
nothing else. Those of networks can be corrected by how fast networks are here
(:func:`~crptpro.experiments.pace.network_pace`): processors of one decade differ ninefold.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch

from crptpro.data.layout import estimate_bytes
from crptpro.domains import get_domain
from crptpro.experiments.budgets import exploration_config, exploration_plan, run_config
from crptpro.experiments.measurements import ProbePiece, RedrawnPiece, TimingPiece
from crptpro.experiments.pieces import (
    DatasetPiece,
    EncoderPiece,
    ExploredPiece,
    FinetunedPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    Settings,
    UntrainedPiece,
)
from crptpro.objectives import get_method
from crptpro.training.action_repeat import action_repeat_of

START_S = 10.0
"""Imports, the first picture, the first update."""
DECISION_S = {"quadruped": 0.06}
USUAL_DECISION_S = 0.03
"""One decision: the simulator, and a picture with exact pixels."""
ENCODER_ROW_S = 2.9e-3
"""An encoder update, for each row of its batch."""
ACT_NETWORKS_S, EVALUATE_NETWORKS_S = 0.02, 0.01
"""A decision of an agent besides simulator and picture: features and action; while it learns, and is evaluated."""
AGENT_ROW_S, DRQ_ROW_S = 0.5e-3, 6.9e-3
"""An agent's update for each row: on stored features, and on two views of pixels with its encoder."""
EXPLORER_ROW_S = {"averaged-sac": 3.5e-3, "skill-ddpg": 2.7e-3}
USUAL_EXPLORER_ROW_S = 1.25e-3
"""An explorer's update for each row, on pixels that are encoded anew, in two views for the averaged one."""
PROBE_SAMPLE_S, PROBE_PAIR_S = 4e-3, 2.5e-6
"""A state probe: features of each sample, and a product for each two of them."""
MEASUREMENT_S = 60.0
"""Any other piece that measures something else than time."""
USUAL_EPISODE_ENV_STEPS = 1_000

IMAGE_SIZE = 84
FEATURES = 39_200
"""Width of an encoder's output."""
NUMBER_BYTES = 4
KEPT_CHECKPOINTS = 2
FRAME_BYTES = 3 * IMAGE_SIZE**2
SLACK_FRAMES = 2_000
"""A replay has room for these beyond its transitions, and for what its last checkpoints refer to."""
OTHER_BYTES = 1_000_000
"""Records of a training, results of a measurement."""


@functools.singledispatch
def core_seconds(piece: Piece, pace: float = 1.0) -> float:
    """Estimate the seconds that a piece takes on one core of the reference machine.

    A kind without a way of its own is taken for a measurement of a minute.

    Args:
        piece: to be made.
        pace: time that networks take by what they take on the reference machine.
    """
    return MEASUREMENT_S


@functools.singledispatch
def stored_bytes(piece: Piece) -> int:
    """Estimate what a finished piece occupies."""
    return OTHER_BYTES


@functools.singledispatch
def working_bytes(piece: Piece) -> int:
    """Estimate what a piece occupies besides while it is made: checkpoints, and a run's replay."""
    return 0


register_seconds: Callable[..., Any] = core_seconds.register
register_stored: Callable[..., Any] = stored_bytes.register
register_working: Callable[..., Any] = working_bytes.register


@register_seconds
def _(piece: DatasetPiece, pace: float = 1.0) -> float:
    return START_S + piece.transitions * DECISION_S.get(piece.domain, USUAL_DECISION_S)


@register_stored
def _(piece: DatasetPiece) -> int:
    return estimate_bytes(piece.transitions, IMAGE_SIZE, None)


@register_seconds
def _(piece: RedrawnPiece, pace: float = 1.0) -> float:
    return START_S + _redrawn_frames(piece) * DECISION_S.get(piece.dataset.domain, USUAL_DECISION_S)


@register_stored
def _(piece: RedrawnPiece) -> int:
    return OTHER_BYTES + _redrawn_frames(piece) * FRAME_BYTES


def _redrawn_frames(piece: RedrawnPiece) -> int:
    return min(piece.frame_stack * piece.samples, piece.dataset.transitions)


@register_seconds
def _(piece: ProbePiece, pace: float = 1.0) -> float:
    return START_S + pace * (piece.samples * PROBE_SAMPLE_S + piece.samples**2 * PROBE_PAIR_S)


# --- encoders -----------------------------------------------------------------------------------------------------


@register_seconds
def _(piece: UntrainedPiece, pace: float = 1.0) -> float:
    return START_S


@register_seconds
def _(piece: PretrainedPiece, pace: float = 1.0) -> float:
    return START_S + pace * piece.updates * _batch_size(piece.method, piece.training) * ENCODER_ROW_S


@register_seconds
def _(piece: FinetunedPiece, pace: float = 1.0) -> float:
    return START_S + pace * piece.updates * _batch_size(piece.base.method, piece.training) * ENCODER_ROW_S


@register_seconds
def _(piece: ExploredPiece, pace: float = 1.0) -> float:
    plan = exploration_plan(piece)
    updates_s = plan.encoder_updates * _batch_size(piece.method, piece.explore) * ENCODER_ROW_S
    return START_S + plan.decisions * _exploring_s(piece, pace) + pace * updates_s


@register_seconds
def _(piece: TimingPiece, pace: float = 1.0) -> float:
    if len(piece.encoders) > 1:
        return 1.0  # a sum
    spent = _timing_s(piece.encoders[0], piece.updates, pace)
    if piece.paper_timed and piece.paper != piece.encoders:
        spent += _timing_s(piece.paper[0], piece.paper_timed, pace)
    return spent


def _timing_s(encoder: EncoderPiece, timed: int, pace: float) -> float:
    updates = 2 * timed
    if not isinstance(encoder, ExploredPiece):
        batch = _batch_size(encoder.method, getattr(encoder, "training", ()))
        return START_S + pace * updates * batch * ENCODER_ROW_S
    plan = exploration_plan(encoder)
    decisions = updates * plan.encoder_update_interval / plan.encoder_updates_each
    batch = _batch_size(encoder.method, encoder.explore)
    return START_S + decisions * _exploring_s(encoder, pace) + pace * updates * batch * ENCODER_ROW_S


@register_stored
def _(piece: EncoderPiece) -> int:
    return OTHER_BYTES + NUMBER_BYTES * _parameters(piece)[1]


@register_working
def _(piece: EncoderPiece) -> int:
    trained, all_of_them = _parameters(piece)
    return KEPT_CHECKPOINTS * NUMBER_BYTES * (all_of_them + 2 * trained)  # Adam has two moments


@register_stored
def _(piece: ExploredPiece) -> int:
    plan, config = exploration_plan(piece), exploration_config(piece)
    kept = min(plan.agent_steps, config.replay_capacity or plan.agent_steps)
    slack = 4 * (config.checkpoint_interval_env_steps // sum(plan.repeats)) + SLACK_FRAMES
    replays = len(piece.domains) * (kept + slack) * FRAME_BYTES
    return OTHER_BYTES + NUMBER_BYTES * _parameters(piece)[1] + replays


@register_working
def _(piece: ExploredPiece) -> int:
    config = exploration_config(piece)
    trained, all_of_them = _parameters(piece)
    agents = len(piece.domains) * _agent_checkpoint(config.bottleneck_dim, config.hidden_dim)
    return KEPT_CHECKPOINTS * (NUMBER_BYTES * (all_of_them + 2 * trained) + agents)


# --- runs ---------------------------------------------------------------------------------------------------------


@register_seconds
def _(piece: RunPiece, pace: float = 1.0) -> float:
    config = run_config(piece)
    repeat = action_repeat_of(piece.task, config.action_repeat)
    row_s = DRQ_ROW_S if config.algorithm == "drq" else AGENT_ROW_S
    episode = get_domain(piece.task).episode_env_steps or USUAL_EPISODE_ENV_STEPS
    evaluations = config.env_steps // config.eval_interval_env_steps + 1
    acting_s = USUAL_DECISION_S + pace * (ACT_NETWORKS_S + row_s * config.batch_size)
    evaluating_s = USUAL_DECISION_S + pace * EVALUATE_NETWORKS_S
    decisions, evaluated = config.env_steps / repeat, evaluations * config.eval_episodes * episode / repeat
    return START_S + decisions * acting_s + evaluated * evaluating_s


@register_stored
def _(piece: RunPiece) -> int:
    config = run_config(piece)
    return OTHER_BYTES + NUMBER_BYTES * _actor_and_critic(config.bottleneck_dim, config.hidden_dim)[0]


@register_working
def _(piece: RunPiece) -> int:
    config = run_config(piece)
    kept = config.replay_capacity or _replay_capacity(piece.encoder)
    repeat = action_repeat_of(piece.task, config.action_repeat)
    slack = 2 * (config.checkpoint_interval_env_steps // repeat) + SLACK_FRAMES
    checkpoints = KEPT_CHECKPOINTS * _agent_checkpoint(config.bottleneck_dim, config.hidden_dim)
    return (kept + slack) * FRAME_BYTES + checkpoints


# --- settings -----------------------------------------------------------------------------------------------------


def _batch_size(method: str, options: Settings) -> int:
    return dict(options).get("batch_size") or get_method(method).defaults.batch_size


def _exploring_s(piece: ExploredPiece, pace: float) -> float:
    """A decision of an explorer, with its share of the agent's updates."""
    interval = exploration_plan(piece).agent_update_interval
    row_s = EXPLORER_ROW_S.get(exploration_config(piece).agent or "", USUAL_EXPLORER_ROW_S)
    updates_s = row_s * _batch_size(piece.method, piece.explore) / interval
    return USUAL_DECISION_S + pace * (ACT_NETWORKS_S + updates_s)


def _replay_capacity(encoder: EncoderPiece | None) -> int:
    """What an encoder's method keeps for agents."""
    first = None if encoder is None else encoder.lineage[-1]
    if first is None or isinstance(first, UntrainedPiece):
        return get_method("crptpro").replay_capacity
    return get_method(first.method).replay_capacity


def _parameters(piece: EncoderPiece) -> tuple[int, int]:
    """Numbers that are trained, and all numbers, targets included; without a training, an encoder's own."""
    first = piece.lineage[-1]
    if isinstance(first, UntrainedPiece):
        return 0, 300_000
    return _loss_parameters(first.method, getattr(first, "loss", ()))


@functools.cache
def _loss_parameters(method: str, options: Settings) -> tuple[int, int]:
    registered = get_method(method)
    with torch.device("meta"):  # shapes without numbers
        loss = registered.build(registered.build_encoder(), **dict(options))
    every = sum(value.numel() for value in loss.state_dict().values() if isinstance(value, torch.Tensor))
    return sum(parameter.numel() for parameter in loss.parameters()), every


def _actor_and_critic(bottleneck: int, hidden: int) -> tuple[int, int]:
    trunk = FEATURES * bottleneck
    inner = bottleneck * hidden + hidden**2
    return trunk + inner, trunk + 2 * inner


def _agent_checkpoint(bottleneck: int, hidden: int) -> int:
    """Bytes of actor, twin critic, its target, and the optimisers' moments."""
    actor, critic = _actor_and_critic(bottleneck, hidden)
    return NUMBER_BYTES * (3 * (actor + critic) + critic)

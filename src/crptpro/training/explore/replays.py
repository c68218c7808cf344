"""The replays of an active pre-training: how large, whether there is room, and one per domain."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.cards import require_disk
from crptpro.data import FrameReplay
from crptpro.training.env_replay import replay_for
from crptpro.training.explore.plan import Plan

logger = logging.getLogger(__name__)

DIRECTORY = "replay"


def _replay_size(config: ActiveConfig, plan: Plan) -> tuple[int, int]:
    """Transitions that a domain's replay keeps, never more than it can get, and frames beyond them.

    What the last two checkpoints refer to must outlive the next one; a transition may bring two frames, where episodes
    are short.
    """
    capacity = min(config.replay_capacity or plan.agent_steps, plan.agent_steps)
    return capacity, 4 * (config.checkpoint_interval_env_steps // sum(plan.repeats)) + 2_000


def require_room(loss: LossModule, config: ActiveConfig, plan: Plan, domains: int, run_dir: Path) -> None:
    """Announce the replays of all domains, and refuse what the disk cannot hold before any is made."""
    path = run_dir / DIRECTORY
    if path.exists():
        return
    size = getattr(loss.encoder, "image_size", 84)
    needed = domains * sum(_replay_size(config, plan)) * 3 * size * size
    logger.info("replays: %.2f GB in %s; they stay there for whoever wants the data", needed / 1e9, path)
    require_disk(run_dir, needed, f"Replays of {domains} domains")


def make_replay(env: EnvBase, config: ActiveConfig, plan: Plan, path: Path) -> FrameReplay:
    """Make the replay of one domain."""
    capacity, slack = _replay_size(config, plan)
    columns = {} if config.skill_dim is None else {"skill": ((config.skill_dim,), torch.float32)}
    return replay_for(env, capacity, path=path, slack=slack, extra_columns=columns)

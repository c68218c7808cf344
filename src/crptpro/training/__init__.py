"""Training: offline pre-training, downstream reinforcement learning, evaluation, checkpoints."""

from crptpro.active_config import ActiveConfig, ExplorationSettings
from crptpro.downstream_config import (
    DownstreamConfig,
    SACSettings,
    SkillDDPGSettings,
    drq_settings,
    skill_ddpg_settings,
)
from crptpro.training.agent import PixelAgent, load_agent, save_agent
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.downstream import DownstreamResult, train_downstream
from crptpro.training.downstream_tasks import train_tasks
from crptpro.training.evaluate import Episode, evaluate, summarize, uniform_policy
from crptpro.training.explore import ActiveResult, pretrain_active, register_intrinsic_reward
from crptpro.training.pretrain import PretrainResult, pretrain

__all__ = [
    "ActiveConfig",
    "ActiveResult",
    "CheckpointDir",
    "CollapseMonitor",
    "DownstreamConfig",
    "DownstreamResult",
    "Episode",
    "ExplorationSettings",
    "PixelAgent",
    "PretrainResult",
    "SACSettings",
    "SkillDDPGSettings",
    "drq_settings",
    "evaluate",
    "load_agent",
    "pretrain",
    "pretrain_active",
    "register_intrinsic_reward",
    "save_agent",
    "skill_ddpg_settings",
    "summarize",
    "train_downstream",
    "train_tasks",
    "uniform_policy",
]

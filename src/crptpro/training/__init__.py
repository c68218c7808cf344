"""The loops: pre-training on datasets, active pre-training, downstream learning, evaluation."""

from crptpro.training.agent import PixelAgent, SACLearner, load_agent, save_agent
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.downstream import DownstreamConfig, DownstreamResult, train_downstream
from crptpro.training.evaluate import Episode, evaluate, summarize, uniform_policy
from crptpro.training.explore import ExploreConfig, ExploreResult, pretrain_active
from crptpro.training.pretrain import PretrainConfig, PretrainResult, finetune, pretrain
from crptpro.training.run import Run

__all__ = [
    "CollapseMonitor",
    "DownstreamConfig",
    "DownstreamResult",
    "Episode",
    "ExploreConfig",
    "ExploreResult",
    "PixelAgent",
    "PretrainConfig",
    "PretrainResult",
    "Run",
    "SACLearner",
    "evaluate",
    "finetune",
    "load_agent",
    "pretrain",
    "pretrain_active",
    "save_agent",
    "summarize",
    "train_downstream",
    "uniform_policy",
]

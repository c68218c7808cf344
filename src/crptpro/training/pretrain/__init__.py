"""Offline pre-training: one loss, several datasets, one update on one domain at a time."""

from crptpro.training.pretrain.loop import pretrain
from crptpro.training.pretrain.result import PretrainResult

__all__ = ["PretrainResult", "pretrain"]

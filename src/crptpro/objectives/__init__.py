"""Objectives: pure functions in ``functional``, one LossModule per method, and the table of methods."""

from crptpro.objectives.base import PretrainingLoss
from crptpro.objectives.contrastive import ATCLoss, BeCLLoss, SimCLRLoss
from crptpro.objectives.methods import Exploration, Method, get_method, method_names, method_of, register_method
from crptpro.objectives.proto import ProtoLoss
from crptpro.objectives.sac import AveragedSACLoss, DrQLoss, RADSACLoss, SkillDDPGLoss

__all__ = [
    "ATCLoss", "AveragedSACLoss", "BeCLLoss", "DrQLoss", "Exploration", "Method", "PretrainingLoss", "ProtoLoss",
    "RADSACLoss", "SimCLRLoss", "SkillDDPGLoss", "get_method", "method_names", "method_of", "register_method",
]  # fmt: skip

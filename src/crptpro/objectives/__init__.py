"""Objectives: pure functions in ``functional``, one LossModule per method, and the registry of methods."""

from crptpro.objectives import builtin as _builtin  # noqa: F401 - registers what the library brings
from crptpro.objectives.atc import ATCLoss
from crptpro.objectives.averaged_sac import AveragedSACLoss
from crptpro.objectives.base import PretrainingLoss
from crptpro.objectives.becl import BeCLLoss
from crptpro.objectives.drq import DrQLoss
from crptpro.objectives.exploration import ExplorationDefaults
from crptpro.objectives.proto import ProtoLoss
from crptpro.objectives.rad_sac import RADSACLoss
from crptpro.objectives.registry import (
    Method,
    MethodDefaults,
    exploration_defaults,
    exploring_method,
    get_method,
    method_defaults,
    method_name_of,
    methods,
    register_method,
)
from crptpro.objectives.simclr import SimCLRLoss
from crptpro.objectives.skill_ddpg import SkillDDPGLoss

__all__ = [
    "ATCLoss",
    "AveragedSACLoss",
    "BeCLLoss",
    "DrQLoss",
    "ExplorationDefaults",
    "Method",
    "MethodDefaults",
    "PretrainingLoss",
    "ProtoLoss",
    "RADSACLoss",
    "SimCLRLoss",
    "SkillDDPGLoss",
    "exploration_defaults",
    "exploring_method",
    "get_method",
    "method_defaults",
    "method_name_of",
    "methods",
    "register_method",
]

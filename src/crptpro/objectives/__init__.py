"""Objectives: pure functions in ``functional``, one LossModule per method, and the registry of methods."""

from crptpro.objectives import builtin as _builtin  # noqa: F401 - registers what the library brings
from crptpro.objectives.averaged_sac import AveragedSACLoss
from crptpro.objectives.base import PretrainingLoss
from crptpro.objectives.drq import DrQLoss
from crptpro.objectives.proto import ProtoLoss
from crptpro.objectives.rad_sac import RADSACLoss
from crptpro.objectives.registry import (
    Method,
    MethodDefaults,
    get_method,
    method_defaults,
    methods,
    register_method,
)
from crptpro.objectives.skill_ddpg import SkillDDPGLoss

__all__ = [
    "AveragedSACLoss",
    "DrQLoss",
    "Method",
    "MethodDefaults",
    "PretrainingLoss",
    "ProtoLoss",
    "RADSACLoss",
    "SkillDDPGLoss",
    "get_method",
    "method_defaults",
    "methods",
    "register_method",
]

"""Objectives: pure functions in ``functional``, one LossModule per method, and the registry of methods."""

from crptpro.objectives import builtin as _builtin  # noqa: F401 - registers what the library brings
from crptpro.objectives.atc import ATCLoss
from crptpro.objectives.base import PretrainingLoss
from crptpro.objectives.becl import BeCLLoss
from crptpro.objectives.exploration import ExplorationDefaults
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
from crptpro.objectives.simclr import SimCLRLoss

__all__ = [
    "ATCLoss",
    "BeCLLoss",
    "ExplorationDefaults",
    "Method",
    "MethodDefaults",
    "PretrainingLoss",
    "ProtoLoss",
    "RADSACLoss",
    "SimCLRLoss",
    "get_method",
    "method_defaults",
    "methods",
    "register_method",
]

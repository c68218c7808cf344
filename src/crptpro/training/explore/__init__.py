"""Active pre-training: agents explore the domains while one encoder learns from all of them."""

from crptpro.training.explore.active import ActiveResult, pretrain_active
from crptpro.training.explore.request import require_explorable
from crptpro.training.explore.rewards import register_intrinsic_reward

__all__ = ["ActiveResult", "pretrain_active", "register_intrinsic_reward", "require_explorable"]

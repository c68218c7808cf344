"""Networks: the pixel encoder, its pre-training heads, and the downstream actor and critic."""

from crptpro.modules.actor_critic import DeterministicActor, SquashedGaussianActor, TwinCritic
from crptpro.modules.encoder import PixelEncoder
from crptpro.modules.heads import AnchorHead, Predictor, Projector, Prototypes, SkillHead
from crptpro.modules.precision import computing, resolve_precision, set_compute_dtype, usable_device
from crptpro.modules.registry import register_network

__all__ = [
    "AnchorHead", "DeterministicActor", "PixelEncoder", "Predictor", "Projector", "Prototypes", "SkillHead",
    "SquashedGaussianActor", "TwinCritic", "computing", "register_network", "resolve_precision",
    "set_compute_dtype", "usable_device",
]  # fmt: skip

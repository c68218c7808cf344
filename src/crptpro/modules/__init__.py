"""Networks: the pixel encoder, its pre-training heads, and the downstream actor and critic."""

from crptpro.modules.actor_critic import SquashedGaussianActor, TwinCritic
from crptpro.modules.contrast_heads import AnchorHead, SkillHead
from crptpro.modules.deterministic_actor import DeterministicActor, FixedSkillActor
from crptpro.modules.encoder import PixelEncoder
from crptpro.modules.heads import Predictor, Projector, Prototypes
from crptpro.modules.layout import is_channels_last, resolve_channels_last, set_channels_last
from crptpro.modules.numerics import computing
from crptpro.modules.pixel_critic import PixelCritic
from crptpro.modules.placement import usable_device
from crptpro.modules.precision import resolve_precision, set_compute_dtype

__all__ = [
    "AnchorHead",
    "DeterministicActor",
    "FixedSkillActor",
    "PixelCritic",
    "PixelEncoder",
    "Predictor",
    "Projector",
    "Prototypes",
    "SkillHead",
    "SquashedGaussianActor",
    "TwinCritic",
    "computing",
    "is_channels_last",
    "resolve_channels_last",
    "resolve_precision",
    "set_channels_last",
    "set_compute_dtype",
    "usable_device",
]

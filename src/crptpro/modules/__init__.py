"""Networks: the pixel encoder, its pre-training heads, and the downstream actor and critic."""

from crptpro.modules.actor_critic import SquashedGaussianActor, TwinCritic
from crptpro.modules.contrast_heads import AnchorHead, SkillHead
from crptpro.modules.encoder import PixelEncoder
from crptpro.modules.heads import Predictor, Projector, Prototypes
from crptpro.modules.precision import resolve_precision, set_compute_dtype

__all__ = [
    "AnchorHead",
    "PixelEncoder",
    "Predictor",
    "Projector",
    "Prototypes",
    "SkillHead",
    "SquashedGaussianActor",
    "TwinCritic",
    "resolve_precision",
    "set_compute_dtype",
]

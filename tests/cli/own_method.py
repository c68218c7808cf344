"""Two methods and an encoder that the library does not know: one for datasets, one that explores."""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.transforms import Transform
from torchrl.objectives import LossModule

from crptpro.modules import Projector, register_network
from crptpro.objectives import Exploration, register_method


@register_network
class SmallEncoder(nn.Module):
    """One convolution and the mean over the image."""

    def __init__(self, in_channels: int = 9, *, image_size: int = 84, width: int = 6) -> None:
        super().__init__()
        self.config = {"in_channels": in_channels, "image_size": image_size, "width": width}
        self.feature_dim = width
        self.conv = nn.Conv2d(in_channels, width, 3)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.conv(pixels.float() / 255).mean((-2, -1))


class SlownessLoss(LossModule):
    """Latents of consecutive observations are near each other and far from the batch's mean."""

    in_keys = ("pixels", ("next", "pixels"))
    out_keys = ("loss_slow",)

    def __init__(self, encoder: nn.Module, *, projector: Projector | None = None, margin: float = 1.0) -> None:
        super().__init__()
        self.encoder, self.projector = encoder, projector or Projector(encoder.feature_dim, 4)
        self.margin = margin

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        now, then = (self.projector(self.encoder(tensordict[key])) for key in ("pixels", ("next", "pixels")))
        spread = (now - now.mean(dim=0)).pow(2).mean()
        return TensorDict({"loss_slow": (now - then).pow(2).mean() + F.relu(self.margin - spread)}, [])


class Activity(Transform):
    """Pays for features that differ from each other."""

    def __init__(self, loss: LossModule, generator: torch.Generator, *, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = tensordict["next", "features"].float()
        return tensordict.set(("next", "intrinsic_reward"), self.scale * features.std(dim=-1, keepdim=True))


DEFAULTS = {"updates": 2, "batch_size": 4, "encoder_tau": None}
SMALL = {"channels": (4, 4), "strides": (2, 1)}

register_method("slowness", SlownessLoss, **DEFAULTS, encoder_class=SmallEncoder)
register_method(
    "slowness-active",
    SlownessLoss,
    **DEFAULTS,
    loss_options={"margin": 0.5},
    encoder_options=SMALL,
    exploration=Exploration(
        reward=functools.partial(Activity, scale=2.0), env_steps=60, encoder_update_interval=5, random_agent_steps=10
    ),
)

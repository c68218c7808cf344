"""What a pre-trained artifact is in memory, and the random-encoder control."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from crptpro.artifact import identity_of
from crptpro.errors import PretrainedError
from crptpro.modules import PixelEncoder
from crptpro.seeding import derive_seed

FORMAT = "crptpro-pretrained"
VERSION = 1
ROLES = ("encoder", "projector", "predictor", "prototypes")
TARGET_ROLES = ("target_encoder", "target_projector")
QUEUE = "queue"
ACTOR = "actor"
REST = "loss"


@dataclass
class Pretrained:
    """A pre-trained encoder and what was trained with it; networks are frozen and in evaluation mode.

    Attributes:
        encoder: images to features.
        projector: features to latents; ``None`` if the method has none. Likewise the others.
        predictor: latents to latents, online branch.
        prototypes: unit vectors in the latent space.
        target_encoder: slow copy of the encoder.
        target_projector: slow copy of the projector.
        queue: candidate latents ``[Q, D]`` if the method keeps some.
        actor: policy that explored while it was pre-trained, for methods that hand it over.
        card: what made it.
        rest: remaining state of the loss (further heads, coefficients), for fine-tuning.
    """

    encoder: PixelEncoder
    projector: nn.Module | None = None
    predictor: nn.Module | None = None
    prototypes: nn.Module | None = None
    target_encoder: nn.Module | None = None
    target_projector: nn.Module | None = None
    queue: Tensor | None = None
    actor: nn.Module | None = None
    card: dict[str, Any] = field(default_factory=dict)
    rest: dict[str, Tensor] = field(default_factory=dict, repr=False)

    @property
    def method(self) -> str:
        """Registered name of the method, or the class name of a loss that is not registered."""
        return str(self.card.get("method", "unknown"))

    @property
    def label(self) -> str:
        """Name in records and reports: the method, with ``-finetune`` if it went on from another artifact."""
        is_finetuned = bool((self.card.get("training") or {}).get("started_from"))
        return f"{self.method}-finetune" if is_finetuned else self.method

    def identity(self) -> str:
        """Return what tells these weights from any others: the method and a checksum."""
        if (named := identity_of(self.card)) is not None:
            return named
        digest = hashlib.sha256()
        for name in (*ROLES, *TARGET_ROLES, ACTOR):
            module = getattr(self, name)
            for key, value in ({} if module is None else module.state_dict()).items():
                digest.update(f"{name}.{key}".encode())
                digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        return f"{self.method}:{digest.hexdigest()}"

    def require(
        self,
        *,
        image_size: int | None = None,
        frame_stack: int | None = None,
        pixel_scale: float | None = None,
        pixel_offset: float | None = None,
        prototypes: bool | None = None,
    ) -> Pretrained:
        """Check what this artifact is about to be used for; ``None`` does not ask. Returns self.

        Args:
            image_size: height and width of the images.
            frame_stack: RGB frames per observation.
            pixel_scale: factor on the 0..255 values.
            pixel_offset: subtracted after scaling.
            prototypes: whether a projector and prototypes are needed.

        Raises:
            PretrainedError: naming everything that does not fit, and both values.
        """
        config = self.encoder.config
        has = {
            "image_size": config.get("image_size"),
            "frame_stack": config.get("in_channels", 0) // 3,
            "pixel_scale": config.get("pixel_scale"),
            "pixel_offset": config.get("pixel_offset"),
        }
        asked = {
            "image_size": image_size,
            "frame_stack": frame_stack,
            "pixel_scale": pixel_scale,
            "pixel_offset": pixel_offset,
        }
        wrong = [
            f"it was trained with {name} {has[name]}, not {value}"
            for name, value in asked.items()
            if value is not None and (has[name] is None or abs(has[name] - value) > 1e-9)
        ]
        if prototypes and (self.prototypes is None or self.projector is None):
            wrong.append(f"it has no prototypes (method {self.method!r})")
        if wrong:
            raise PretrainedError(
                f"The pretrained encoder ({self.method}) does not fit: {'; '.join(wrong)}. "
                "Use an artifact made for this, or change the settings to match it."
            )
        return self


def random_pretrained(seed: int = 0, **encoder_config: Any) -> Pretrained:
    """Return the random-encoder control: frozen at initialisation, no heads, no prototypes.

    Args:
        seed: seeds the initialisation; the global generator is left as it was.
        **encoder_config: arguments of :class:`~crptpro.modules.PixelEncoder`.

    Examples:
        >>> random_pretrained(channels=(4,), strides=(2,), image_size=16).method
        'random-encoder'
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "random_pretrained"))
        encoder = PixelEncoder(**encoder_config)
    encoder.requires_grad_(False).eval()
    return Pretrained(encoder, card={"method": "random-encoder", "training": None, "seed": seed})

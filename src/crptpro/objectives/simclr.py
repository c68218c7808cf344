"""SimCLR as APT trains its encoder: tell two views of an observation from views of other observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import nn

from crptpro.modules import Projector
from crptpro.modules.heads import latent_dim_of
from crptpro.objectives.base import PretrainingLoss, require_positive
from crptpro.objectives.functional import info_nce, mean_pairwise_cosine


class SimCLRLoss(PretrainingLoss):
    r"""Contrast of two independently shifted views, without target network (APT, arXiv 2103.04551).

    Views :math:`z = g_\theta(f_\theta(\cdot))/\|\cdot\|` of both images of B observations; each of the 2B has the
    other view of its observation as positive and the remaining 2B - 2 as negatives:

    .. math:: L = -\frac1{2B}\sum_i \log\frac{\exp(z_i\cdot z_{p(i)}/\tau)}{\sum_{j\ne i}\exp(z_i\cdot z_j/\tau)} .

    It says in :attr:`views` that ``pixels_view`` is a second view of ``pixels``;
    :func:`~crptpro.training.pretrain` makes it by shifting the same images again.

    Deviation: APT has published no code for DeepMind Control; loss and temperature are those of the authors' code
    for Atari, the head (one linear layer, 128) is the one that every method here has.

    Args:
        encoder: images ``[B, C, H, W]`` to features ``[B, encoder.feature_dim]``.
        projector: features to latents ``[B, D]``; default ``Projector(encoder.feature_dim, latent_dim)``.
        latent_dim: D.
        temperature: tau, positive.

    Raises:
        ValueError: a temperature that is not positive.

    Returns (``forward``):
        Scalar ``loss_contrast`` (nats) and, detached, ``embedding_cosine`` (mean pairwise cosine of the first
        views' latents).
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            observation: images.
            observation_view: the same images, augmented independently.
        """

        observation: NestedKey = "pixels"
        observation_view: NestedKey = "pixels_view"

    default_keys = _AcceptedKeys  # type: ignore[assignment]
    tensor_keys: _AcceptedKeys  # type: ignore[assignment]

    network_names = ("encoder", "projector")
    default_out_keys = ("loss_contrast", "embedding_cosine")
    _schedulable_buffers = frozenset({"temperature"})

    def __init__(
        self,
        encoder: nn.Module,
        *,
        projector: nn.Module | None = None,
        latent_dim: int = 128,
        temperature: float = 0.07,
    ) -> None:
        super().__init__()
        require_positive(temperature=temperature)
        if projector is None:
            projector = Projector(cast(int, encoder.feature_dim), latent_dim)
        self.convert_to_functional(encoder, "encoder")
        self.convert_to_functional(projector, "projector")
        self.latent_dim = latent_dim_of(projector) or latent_dim
        self._register_coefficients(temperature=temperature)

    @property
    def views(self) -> dict[NestedKey, NestedKey]:
        """The second view of the observation, by its key."""
        return {self.tensor_keys.observation_view: self.tensor_keys.observation}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss and diagnostics of one batch; see the class."""
        keys = (self.tensor_keys.observation, self.tensor_keys.observation_view)
        latents = self._latents(torch.cat([self._read(tensordict, key) for key in keys]))
        with torch.autocast(device_type=latents.device.type, enabled=False):
            one, two = F.normalize(latents, dim=-1).chunk(2)
            out = {
                "loss_contrast": info_nce(one, two, temperature=self.temperature, negatives="both"),
                "embedding_cosine": mean_pairwise_cosine(one.detach()),
            }
        return TensorDict(out, batch_size=[])

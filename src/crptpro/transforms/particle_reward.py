"""The exploration bonus of APT: how far a new state is from the others of its batch."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from crptpro.modules.precision import device_of
from crptpro.objectives.functional import knn_distances, particle_entropy
from crptpro.transforms.base import IntrinsicReward
from crptpro.values import as_int

# Below this a scale says that all particles coincide; their distances are 0 too, and so is the bonus.
_SMALLEST_SCALE = 1e-8

CLIP = 1e-4
"""Subtracted from each scaled distance (rll-research/url_benchmark)."""


class ParticleReward(IntrinsicReward):
    r"""Compute the particle-entropy reward (APT, arXiv 2103.04551).

    .. math::
        \hat r_i = \log\Big(1 + \frac1k \sum_{j=1}^k \mathrm{relu}\big(d_{ij} / s - 10^{-4}\big)\Big)

    with :math:`d_{ij}` the distance between a projection, not normalised, and its j-th nearest among the
    projections of the same batch, itself included (:math:`d_{i1} = 0`), and s the running mean of these
    distances over all calls. The mean takes the batch in before it is used; distances that are not finite do not enter
    it. Source of this form: rll-research/url_benchmark ``utils.py`` (``PBE`` and ``RMS``).

    Deviation: in a batch smaller than k the whole batch are the neighbours, and a single particle earns 0; the
    published code fails there. Where all distances seen so far are 0 the bonus is 0; there it is not a number.

    Args:
        projector: maps features to the latent space; None if ``in_keys`` already names projections.
        k: neighbours, the particle itself included.
        **options: ``coef``, ``in_keys``, ``out_keys`` and ``reward_key`` of
            :class:`~crptpro.transforms.base.IntrinsicReward`.

    Raises:
        ValueError: ``k`` below 2, or more than one key.
    """

    projector: nn.Module | None
    distance_mean: Tensor
    distance_count: Tensor

    def __init__(
        self,
        projector: nn.Module | None,
        *,
        k: int = 12,
        **options: Any,
    ) -> None:
        super().__init__({"projector": projector}, **options)
        self.k = as_int(k, "k", minimum=2)
        where = None if projector is None else device_of(projector)
        # The published starting point: mean 0, as if seen a ten-thousandth of a time.
        self.register_buffer("distance_mean", torch.zeros((), dtype=torch.float64, device=where))
        self.register_buffer("distance_count", torch.full((), 1e-4, dtype=torch.float64, device=where))

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor) -> Tensor:
        r"""Take this batch's distances into the running mean and return the reward before the coefficient.

        Args:
            features: ``[B, feature_dim]``, or ``[B, D]`` without a projector; any floating dtype.

        Returns:
            float32 ``[B]``, non-negative.
        """
        latents = (features if self.projector is None else self.projector(features)).float()
        count = latents.shape[0]
        if count < 2:
            return latents.new_zeros(count)
        distances = knn_distances(latents, latents, k=min(self.k, count))
        self._take_in(distances.to(self.distance_mean))
        scale = self.distance_mean.clamp_min(_SMALLEST_SCALE).to(distances)
        return particle_entropy(distances, scale=scale, clip=CLIP)

    def _take_in(self, distances: Tensor) -> None:
        # In float64 without reading from the device; one NaN taken in would stay for ever.
        finite = distances.isfinite()
        self.distance_count.add_(finite.sum())
        deviations = torch.where(finite, distances - self.distance_mean, 0.0)
        self.distance_mean.add_(deviations.sum() / self.distance_count)

    def _intrinsic_reward(self, features: Tensor, tensordict: TensorDictBase) -> Tensor:
        return self.intrinsic_reward(features)

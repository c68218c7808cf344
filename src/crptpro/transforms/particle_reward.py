"""The exploration bonus of APT: how far a new state is from the others of its batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from crptpro.objectives.functional import knn_distances
from crptpro.objectives.particles import merge_moments, particle_entropy
from crptpro.transforms.intrinsic_reward import IntrinsicReward

# Below this a scale says that all particles coincide; their distances are 0 too, and so is the bonus.
_SMALLEST_SCALE = 1e-8


class ParticleReward(IntrinsicReward):
    r"""Add the particle-entropy bonus to the reward (APT, arXiv 2103.04551).

    .. math::
        \hat r_i = \log\Big(1 + \frac1k \sum_{j=1}^k \mathrm{relu}\big(d_{ij} / s - c\big)\Big)

    with :math:`d_{ij}` the distance between a projection, not normalised, and its j-th nearest among the
    projections of the same batch, itself included (:math:`d_{i1} = 0`), and s a running statistic of these
    distances over all calls. The statistic takes the batch in before it is used. Source of this form:
    rll-research/url_benchmark ``utils.py`` (``PBE`` and ``RMS``); APT's authors publish no code for DMControl.

    Works on replay batches (``forward``, keys under ``"next"``) and on environments, where the batch is what
    one step returns: a vectorised environment of N gives N particles. On a single environment that is one,
    which has no neighbour: it earns 0 and leaves the statistic alone. Never put it on evaluation
    environments. Sampling leaves stored rewards as they are; see :meth:`forward` for the one way of reading a
    buffer that does not. Nothing depends on training mode.

    Deviation: in a batch smaller than k the whole batch are the neighbours; the published code fails there.
    Where all distances seen so far are 0 the bonus is 0; there it is not a number.

    Args:
        projector: maps features to the latent space; None if ``in_keys`` already names projections.
        intrinsic_reward_coef: :math:`\beta` in :math:`r_\mathrm{ext} + \beta \hat r`.
        k: neighbours, the particle itself included.
        average: the mean over the k neighbours; False takes the k-th alone, and the statistic too.
        scale: s: ``"running_mean"``, ``"running_variance"`` (as the authors' Atari code), or ``"none"`` for 1.
        clip: c, subtracted from each distance after the division.
        in_keys: one key, features ``[*, feature_dim]`` (or projections ``[*, D]``) of the next observation.
        out_keys: one key for :math:`\hat r`, of the reward's shape.
        reward_key: :math:`r_\mathrm{ext}`, ``[*, 1]``; None writes :math:`\hat r` only.
        out_reward_key: where :math:`r_\mathrm{ext} + \beta \hat r` goes; ``reward_key`` when None.

    Keys name entries of an environment's step; in replay batches they are read and written under
    ``"next"``. A leading ``"next"`` in a key is therefore ignored.

    Raises:
        ValueError: ``k`` below 2, a negative ``clip``, an unknown ``scale``, or more than one key.

    Examples:
        >>> from tensordict import TensorDict
        >>> bonus = ParticleReward(None, k=3, reward_key=None)  # features that are projections already
        >>> batch = bonus(TensorDict({"next": {"features": torch.randn(5, 4)}}, [5]))
        >>> batch["next", "intrinsic_reward"].shape
        torch.Size([5, 1])
    """

    own_state: ClassVar[tuple[str, ...]] = ("distance_mean", "distance_variance", "distance_count")
    distance_mean: Tensor
    distance_variance: Tensor
    distance_count: Tensor

    def __init__(
        self,
        projector: nn.Module | None,
        *,
        intrinsic_reward_coef: float = 0.2,
        k: int = 12,
        average: bool = True,
        scale: Literal["running_mean", "running_variance", "none"] = "running_mean",
        clip: float = 1e-4,
        in_keys: NestedKey | Sequence[NestedKey] = "features",
        out_keys: NestedKey | Sequence[NestedKey] = "intrinsic_reward",
        reward_key: NestedKey | None = "reward",
        out_reward_key: NestedKey | None = None,
    ) -> None:
        if k < 2:
            raise ValueError(f"k counts the particle itself and must be at least 2, got {k}.")
        if clip < 0:
            raise ValueError(f"clip must not be negative, got {clip}.")
        if scale not in ("running_mean", "running_variance", "none"):
            raise ValueError(f"scale must be 'running_mean', 'running_variance' or 'none', got {scale!r}.")
        super().__init__(
            intrinsic_reward_coef=intrinsic_reward_coef,
            in_keys=in_keys,
            out_keys=out_keys,
            reward_key=reward_key,
            out_reward_key=out_reward_key,
        )
        self.projector = projector
        self.k, self.average, self.scale, self.clip = k, average, scale, clip
        where = None if projector is None else next((p.device for p in projector.parameters()), None)
        # The published starting point: mean 0 and variance 1, as if seen a ten-thousandth of a time.
        for name, start in zip(self.own_state, (0.0, 1.0, 1e-4)):
            self.register_buffer(name, torch.tensor(start, dtype=torch.float64, device=where))

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor) -> Tensor:
        r"""Take this batch's distances into the statistic and return the bonus before :math:`\beta`.

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
        if not self.average:
            distances = distances[:, -1:]
        before = (self.distance_mean, self.distance_variance, self.distance_count)
        for kept, now in zip(before, merge_moments(*before, distances)):
            kept.copy_(now)
        statistics = {"running_mean": self.distance_mean, "running_variance": self.distance_variance}
        statistic = statistics.get(self.scale)
        scale = 1.0 if statistic is None else statistic.clamp_min(_SMALLEST_SCALE).to(distances)
        return particle_entropy(distances, scale=scale, clip=self.clip)

    def _bonus(self, features: Tensor, root: TensorDictBase) -> Tensor:
        return self.intrinsic_reward(features)

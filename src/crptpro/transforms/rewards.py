"""Intrinsic rewards of replay batches: CRPTpro's prototypes, APT's particles, BeCL's skills."""

from __future__ import annotations

import logging
from typing import Any, Self

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs.transforms import Transform

from crptpro.modules.precision import device_of, evaluating
from crptpro.objectives.base import require_positive, skills_of
from crptpro.objectives.functional import becl_loss, knn_distance, knn_distances, particle_entropy
from crptpro.transforms.base import Keys
from crptpro.values import as_int, read_entry

logger = logging.getLogger(__name__)


class IntrinsicReward(Transform):
    r"""Computes an intrinsic reward from the features of next observations: :math:`r = r_\mathrm{ext} + c \hat r`.

    ``in_keys`` is one key, features ``[*, D]`` of the next observation, ``out_keys`` one key for :math:`\hat r`, of the
    reward's shape. :math:`r` replaces ``reward_key`` ``[*, 1]``, unless ``coef``, :math:`c`, is None. The state
    dictionary excludes ``projector``, a network on the features (None if they are projected already).
    """

    projector: nn.Module | None
    extra_keys: tuple[NestedKey, ...] = ()  # further entries that ``intrinsic_reward`` takes

    def __init__(
        self,
        projector: nn.Module | None,
        *,
        coef: float | None = None,
        in_keys: Keys = ("next", "features"),
        out_keys: Keys = ("next", "intrinsic_reward"),
        reward_key: NestedKey = ("next", "reward"),
    ) -> None:
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        if len(self.in_keys) != 1 or len(self.out_keys) != 1:
            keys = f"{self.in_keys} and {self.out_keys}"
            raise ValueError(f"{type(self).__name__} reads and writes one key each, got {keys}.")
        self.__dict__["projector"] = projector
        self.coef = coef
        self.reward_key = reward_key

    def intrinsic_reward(self, features: Tensor, *extra: Tensor) -> Tensor:
        """Return the reward of rows ``[B, D]``, float32 ``[B]``, without coefficient; updates the queue or the mean."""
        raise NotImplementedError

    def _project(self, features: Tensor) -> Tensor:
        if self.projector is None:
            return features.float()
        with evaluating(self.projector):  # it may be in training
            projected: Tensor = self.projector(features)
        return projected.float()

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = read_entry(self, tensordict, self.in_keys[0])
        # A sample may be on the CPU, and the networks on a GPU.
        where = next((tensor.device for tensor in self.buffers()), None)
        where = where or (None if self.projector is None else device_of(self.projector)) or features.device
        rows = features.reshape(-1, features.shape[-1]).to(where)
        extra = [read_entry(self, tensordict, key).reshape(len(rows), -1).to(where) for key in self.extra_keys]
        intrinsic = self.intrinsic_reward(rows, *extra)
        if self.coef is None:
            return tensordict.set(self.out_keys[0], intrinsic.reshape(*features.shape[:-1], 1))
        # The result stays on the networks' device, so that a GPU need not be synchronised.
        reward = read_entry(self, tensordict, self.reward_key).to(intrinsic.device)
        intrinsic = intrinsic.to(reward.dtype).view_as(reward)
        tensordict.set(self.out_keys[0], intrinsic)
        # A new tensor: the sampled reward may share memory with the storage.
        return tensordict.set(self.reward_key, reward + self.coef * intrinsic)

    def transform_output_spec(self, output_spec: TensorSpec) -> TensorSpec:
        raise NotImplementedError(f"{type(self).__name__} rewards replay batches; attach it to a buffer.")

    def clone(self) -> Self:
        """Return a transform without parent and with separate state; networks and generator are shared."""
        copy = super().clone()
        copy._buffers = {name: value.clone() for name, value in self._buffers.items() if value is not None}
        return copy


class PrototypeReward(IntrinsicReward):
    r"""Add the prototype-kNN exploration bonus, :math:`r = r_\mathrm{ext} + \beta \hat r` (CRPTpro, Eq. 11).

    With :math:`z_i` the l2-normalised projections of a batch of next observations and :math:`c_j` the
    l2-normalised prototypes, each call

    1. draws one candidate per prototype, :math:`i_j \sim \mathrm{Categorical}_i(\mathrm{softmax}_i(c_j \cdot z_i))`;
    2. puts the M vectors :math:`z_{i_j}` into the first-in-first-out queue Q;
    3. computes :math:`\hat r_i = \lVert z_i - \mathrm{NN}_k(z_i; Q) \rVert_2`, in [0, 2].

    As in the released agent (liuxin0824/CRPTpro ``proto.py``), a sample drawn k times or more gets exactly 0, because
    its copies in Q are its neighbours: about 8 % of a batch of 512 with 512 prototypes and k = 3. Empty rows of Q are
    at distance 1. Rows that are not finite are never drawn. Batches must be larger than M / (k - 1/3), 192 for 512
    prototypes, for most rows to get a bonus; smaller ones cause a warning. A single row gets 0 and leaves Q unchanged.
    Deviation: Eq. 11 prints projections without normalisation; they are normalised here, as in the released agent,
    which also takes Q over from pre-training. Here Q starts from zeros unless ``queue`` is given.

    Args:
        projector: frozen map from features to latents; None if ``in_keys`` already names projections.
        prototypes: :class:`~crptpro.modules.Prototypes`, not necessarily normalised.
        coef: :math:`\beta`; None writes :math:`\hat r` only.
        knn_k: k, including copies of the sample itself; at most ``queue_size``.
        queue_size: length of Q, a multiple of M.
        queue: initial Q ``[queue_size, D]``, oldest row first; zeros when None.
        generator: source of the draws, which the state dict excludes; the device's global one when None.
        **keys: ``in_keys``, ``out_keys`` and ``reward_key`` of :class:`~crptpro.transforms.rewards.IntrinsicReward`.
    """

    prototypes: nn.Module
    queue: Tensor
    queue_pointer: Tensor
    _has_warned = False

    def __init__(
        self,
        projector: nn.Module | None,
        prototypes: nn.Module,
        *,
        coef: float | None = 0.2,
        knn_k: int = 3,
        queue_size: int = 2048,
        queue: Tensor | None = None,
        generator: torch.Generator | None = None,
        **keys: Any,
    ) -> None:
        weight = prototypes.get_parameter("weight")
        num_prototypes, latent_dim = weight.shape
        queue_size = as_int(queue_size, "queue_size", minimum=1)
        if queue_size % num_prototypes:
            raise ValueError(f"queue_size must be a multiple of num_prototypes, got {queue_size} and {num_prototypes}.")
        start = torch.zeros(queue_size, latent_dim) if queue is None else queue
        if start.shape != (queue_size, latent_dim):
            raise ValueError(f"expected a queue of shape {(queue_size, latent_dim)}, got {tuple(start.shape)}.")
        super().__init__(projector, coef=coef, **keys)
        self.__dict__["prototypes"] = prototypes
        self.knn_k = as_int(knn_k, "knn_k", minimum=1, maximum=queue_size)
        self.generator = generator
        self.register_buffer("queue", start.detach().to(weight.device, torch.float32, copy=True))
        self.register_buffer("queue_pointer", torch.tensor(0, device=weight.device))

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor, *extra: Tensor) -> Tensor:
        latents = F.normalize(self._project(features), dim=-1)
        if latents.shape[-1] != self.queue.shape[-1]:
            raise ValueError(
                f"projections have length {latents.shape[-1]}, the prototypes {self.queue.shape[-1]}; use the "
                "projector they were trained with."
            )
        if len(latents) < 2:
            return latents.new_zeros(len(latents))
        weight = self.prototypes.get_parameter("weight")
        self.warn_if_mostly_zero(len(latents))
        candidates = draw_candidates(F.normalize(weight.float(), dim=-1) @ latents.T, self.generator)
        count = candidates.shape[0]
        rows = (self.queue_pointer + torch.arange(count, device=latents.device)) % self.queue.shape[0]
        self.queue.index_copy_(0, rows, latents[candidates].to(self.queue.dtype))
        self.queue_pointer.add_(count).remainder_(self.queue.shape[0])
        return knn_distance(latents, self.queue.to(latents.dtype), k=self.knn_k)

    def warn_if_mostly_zero(self, batch_size: int) -> None:
        """Warn once if most rows of such batches will get 0; a row is drawn about Poisson(M / B) times."""
        num_prototypes = len(self.prototypes.get_parameter("weight"))
        too_few = int(num_prototypes / (self.knn_k - 1 / 3))  # the median of the draws is k from M / B = k - 1/3 on
        if batch_size <= too_few and not self._has_warned:
            self._has_warned = True
            logger.warning(
                "The prototype reward will mostly be 0: %d prototypes draw their candidates from batches of %d, so "
                "that the %d nearest candidates of a row are the row itself. Take batches of more than %d, or fewer "
                "prototypes.", num_prototypes, batch_size, self.knn_k, too_few,
            )  # fmt: skip


def draw_candidates(logits: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw one sample per prototype, int64 ``[M]``, with probability softmax over the batch of logits ``[M, B]``.

    By inversion, without host synchronisation. Samples with NaN are never drawn. The generator, by default the global
    one of the logits' device, may be on any device.
    """
    cumulative = logits.masked_fill(logits.isnan(), -torch.inf).softmax(dim=-1).cumsum(dim=-1)
    source = logits.device if generator is None else generator.device
    uniform = torch.rand(logits.shape[0], 1, generator=generator, device=source).to(logits.device)
    # Rounding must not move a draw just below 1 past the last sample.
    target = torch.minimum(uniform * cumulative[:, -1:], torch.nextafter(cumulative[:, -1:], -uniform.new_ones(())))
    drawn = torch.searchsorted(cumulative, target, right=True)
    return drawn.squeeze(-1).clamp_max(logits.shape[1] - 1)


class ParticleReward(IntrinsicReward):
    r"""Compute the particle-entropy reward (APT, arXiv 2103.04551).

    .. math::
        \hat r_i = \log\Big(1 + \frac1k \sum_{j=1}^k \mathrm{relu}\big(d_{ij} / s - 10^{-4}\big)\Big)

    with :math:`d_{ij}` the distance between a projection, not normalised, and its j-th nearest in the batch, itself
    included (:math:`d_{i1} = 0`), and s the running mean of all finite distances so far, this batch included (``PBE``
    and ``RMS`` of rll-research/url_benchmark). ``options`` are :class:`~crptpro.transforms.rewards.IntrinsicReward`'s.

    Deviation: a batch smaller than k uses all its rows, and a single row gets 0; the published code fails. While all
    distances are 0 the reward is 0, in the published code NaN.
    """

    distance_mean: Tensor
    distance_count: Tensor

    def __init__(self, projector: nn.Module | None, *, k: int = 12, **options: Any) -> None:
        super().__init__(projector, **options)
        self.k = as_int(k, "k", minimum=2)
        where = None if projector is None else device_of(projector)
        # The published start: mean 0 with a weight of 1e-4 distances.
        self.register_buffer("distance_mean", torch.zeros((), dtype=torch.float64, device=where))
        self.register_buffer("distance_count", torch.full((), 1e-4, dtype=torch.float64, device=where))

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor, *extra: Tensor) -> Tensor:
        latents = self._project(features)
        count = latents.shape[0]
        if count < 2:
            return latents.new_zeros(count)
        distances = knn_distances(latents, latents, k=min(self.k, count))
        # In float64 and without host synchronisation. A NaN would stay in the mean for ever.
        finite = distances.isfinite()
        self.distance_count.add_(finite.sum())
        deviations = torch.where(finite, distances.to(self.distance_mean) - self.distance_mean, 0.0)
        self.distance_mean.add_(deviations.sum() / self.distance_count)
        # The mean is smaller only while all particles coincide; their distances are 0, and so is the reward.
        scale = self.distance_mean.clamp_min(1e-8).to(distances)
        return particle_entropy(distances, scale=scale, clip=1e-4)


class ContrastiveReward(IntrinsicReward):
    r"""Compute the skill-contrastive reward (BeCL, arXiv 2305.04477; Rooshy-yang/BeCL ``agent/becl.py``).

    .. math::
        \hat r_i = e^{-\ell_i} = \frac{\exp(f_i \cdot f_{p(i)} / T)}{\sum_{j \ne i} \exp(f_i \cdot f_j / T)}

    with :math:`\ell_i` the :func:`~crptpro.objectives.functional.becl_loss` of each row, :math:`f_i` the l2-normalised
    embeddings of a batch of next observations and p(i) the first other row with the same skill, or without one the
    first other row; in (0, 1].

    Deviation: a batch of one gets 0; the published code fails.

    ``head`` gives the embeddings, ``skill_key`` is the one-hot skill ``[*, K]`` at the root, others raise a
    ``ValueError``; ``options`` are :class:`~crptpro.transforms.rewards.IntrinsicReward`'s.
    """

    def __init__(
        self, head: nn.Module | None, *, temperature: float = 0.5, skill_key: NestedKey = "skill", **options: Any
    ) -> None:
        require_positive(temperature=temperature)
        super().__init__(head, **options)
        self.temperature = float(temperature)
        self.extra_keys = (skill_key,)

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor, *extra: Tensor) -> Tensor:
        embeddings = self._project(features)
        if len(embeddings) < 2:
            return embeddings.new_zeros(len(embeddings))
        skills = skills_of(extra[0], len(embeddings))
        return becl_loss(embeddings, skills, temperature=self.temperature, reduction="none").neg().exp()

"""The exploration bonus of CRPTpro: how far a new state is from what the prototypes recently picked."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from crptpro.modules.heads import latent_dim_of
from crptpro.objectives.functional import knn_distance
from crptpro.transforms.intrinsic_reward import IntrinsicReward

logger = logging.getLogger(__name__)


class PrototypeReward(IntrinsicReward):
    r"""Add the prototype-kNN exploration bonus to the reward (CRPTpro, Eq. 10-11).

    .. math:: r = r_\mathrm{ext} + \beta \hat r

    With :math:`z_i` the l2-normalised projections of a batch of next observations and :math:`c_j` the
    l2-normalised prototypes, each call

    1. draws one candidate per prototype,
       :math:`i_j \sim \mathrm{Categorical}_i(\mathrm{softmax}_i(c_j \cdot z_i / T))`;
    2. puts the M vectors :math:`z_{i_j}` into the first-in-first-out queue Q;
    3. then takes :math:`\hat r_i = \lVert z_i - \mathrm{NN}_k(z_i; Q) \rVert_2`, in [0, 2].

    As in the released agent (liuxin0824/CRPTpro ``proto.py``), copies of a sample that were just drawn
    count as neighbours, so a sample drawn k times or more gets exactly 0 (about 8 % of a batch of 512 with
    512 prototypes and k = 3), and rows of the queue not yet filled are zero vectors at distance 1.

    Works on replay batches (``forward``, keys under ``"next"``) and on environments. The candidates come
    from the batch at hand: on a single environment that is one sample, which fills the queue with itself
    and earns 0 unless ``knn_exclude_self``; use replay batches or many environments. Never put it on
    evaluation environments. Sampling leaves stored rewards as they are; see :meth:`forward` for the one way
    of reading a buffer that does not. Nothing depends on training mode.

    Deviation: the released pre-training fills Q on the way and hands it over; here Q starts from zeros unless
    ``queue`` is given.

    Args:
        projector: maps features to the latent space, frozen; None if ``in_keys`` already names projections.
        prototypes: M prototypes, a :class:`~crptpro.modules.Prototypes` or a tensor ``[M, D]``, any row
            length.
        intrinsic_reward_coef: :math:`\beta`.
        knn_k: k, counted with copies of the sample itself.
        queue_size: length of Q, a multiple of M.
        candidate_temperature: T. 1 is close to uniform, because cosines lie in [-1, 1].
        knn_exclude_self: ignore entries that this very call copied from the sample.
        reward_norm: ``"rms"`` divides :math:`\hat r` by the root of the running mean of its square (all
            calls so far, this one included). Deviation: neither the paper nor the released code normalises;
            None does not.
        in_keys: one key, features ``[*, feature_dim]`` (or projections ``[*, D]``) of the next observation.
        out_keys: one key for :math:`\hat r`, of the reward's shape.
        reward_key: :math:`r_\mathrm{ext}`, ``[*, 1]``; None writes :math:`\hat r` only.
        out_reward_key: where :math:`r_\mathrm{ext} + \beta \hat r` goes; ``reward_key`` when None.
        queue: ``[queue_size, D]`` to start from, such as a checkpoint's; zeros when None.
        queue_pointer: row of ``queue`` that is overwritten first.
        generator: source of the draws; the global generator of the device when None. Not part of the state
            dict.

    Keys name entries of an environment's step; in replay batches they are read and written under
    ``"next"``. A leading ``"next"`` in a key is therefore ignored.

    Raises:
        ValueError: a queue size that is no multiple of M, a queue of another shape, more than one key,
            non-positive ``knn_k`` or ``candidate_temperature``, an unknown ``reward_norm``, or a projector
            whose outputs are not as long as the prototypes.

    Examples:
        >>> from tensordict import TensorDict
        >>> bonus = PrototypeReward(None, torch.eye(4), queue_size=8)  # features that are projections already
        >>> after = {"features": torch.randn(5, 4), "reward": torch.zeros(5, 1)}
        >>> batch = bonus(TensorDict({"next": after}, [5]))
        >>> torch.equal(batch["next", "reward"], 0.2 * batch["next", "intrinsic_reward"])
        True
    """

    own_state: ClassVar[tuple[str, ...]] = ("queue", "queue_pointer", "reward_square_sum", "reward_count")
    queue: Tensor
    queue_pointer: Tensor
    reward_square_sum: Tensor
    reward_count: Tensor

    def __init__(
        self,
        projector: nn.Module | None,
        prototypes: nn.Module | Tensor,
        *,
        intrinsic_reward_coef: float = 0.2,
        knn_k: int = 3,
        queue_size: int = 2048,
        candidate_temperature: float = 1.0,
        knn_exclude_self: bool = False,
        reward_norm: Literal["rms"] | None = None,
        in_keys: NestedKey | Sequence[NestedKey] = "features",
        out_keys: NestedKey | Sequence[NestedKey] = "intrinsic_reward",
        reward_key: NestedKey | None = "reward",
        out_reward_key: NestedKey | None = None,
        queue: Tensor | None = None,
        queue_pointer: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        if reward_norm not in (None, "rms"):
            raise ValueError(f"reward_norm must be None or 'rms', got {reward_norm!r}.")
        if candidate_temperature <= 0:
            raise ValueError(f"candidate_temperature must be positive, got {candidate_temperature}.")
        weight = prototypes if isinstance(prototypes, Tensor) else prototypes.get_parameter("weight")
        num_prototypes, latent_dim = weight.shape
        if queue_size < 1 or queue_size % num_prototypes:
            raise ValueError(
                f"queue_size must be a multiple of num_prototypes, got {queue_size} and {num_prototypes}."
            )
        if not 1 <= knn_k <= queue_size:
            raise ValueError(f"knn_k must lie in 1..queue_size, got {knn_k} with queue_size {queue_size}.")
        if queue is not None and queue.shape != (queue_size, latent_dim):
            raise ValueError(
                f"expected a queue of shape {(queue_size, latent_dim)}, got {tuple(queue.shape)}."
            )
        told = None if projector is None else latent_dim_of(projector)
        if told is not None:
            _check_latents(told, latent_dim)
        super().__init__(
            intrinsic_reward_coef=intrinsic_reward_coef,
            in_keys=in_keys,
            out_keys=out_keys,
            reward_key=reward_key,
            out_reward_key=out_reward_key,
        )
        self.projector = projector
        if isinstance(prototypes, Tensor):
            self.register_buffer("prototypes", prototypes.detach().clone())
        else:
            self.prototypes = prototypes
        self.knn_k = knn_k
        self.candidate_temperature = candidate_temperature
        self.knn_exclude_self = knn_exclude_self
        self.reward_norm = reward_norm
        self.generator = generator
        start = torch.zeros(queue_size, latent_dim, device=weight.device) if queue is None else queue
        self.register_buffer("queue", start.detach().to(weight.device, torch.float32, copy=True))
        self.register_buffer("queue_pointer", torch.tensor(queue_pointer % queue_size, device=weight.device))
        self.register_buffer("reward_square_sum", torch.zeros((), dtype=torch.float64, device=weight.device))
        self.register_buffer("reward_count", torch.zeros((), dtype=torch.int64, device=weight.device))

    def reset_queue(self) -> None:
        """Empty the queue: all rows zero, pointer at the first. The running statistics of ``"rms"`` stay."""
        self.queue.zero_()
        self.queue_pointer.zero_()

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor) -> Tensor:
        r"""Insert this batch's candidates into the queue and return the bonus before :math:`\beta`.

        Args:
            features: ``[B, feature_dim]``, or ``[B, D]`` without a projector; any floating dtype.

        Returns:
            float32 ``[B]``.

        Raises:
            ValueError: projections that are not as long as the prototypes.
        """
        latents = features if self.projector is None else self.projector(features)
        _check_latents(latents.shape[-1], self.queue.shape[-1])
        latents = F.normalize(latents.float(), dim=-1)
        prototypes = self.prototypes
        weight = prototypes if isinstance(prototypes, Tensor) else prototypes.get_parameter("weight")
        scores = F.normalize(weight.float(), dim=-1) @ latents.T
        candidates = draw_candidates(scores / self.candidate_temperature, self.generator)
        count = candidates.shape[0]
        rows = (self.queue_pointer + torch.arange(count, device=latents.device)) % self.queue.shape[0]
        self.queue.index_copy_(0, rows, latents[candidates])
        self.queue_pointer.add_(count).remainder_(self.queue.shape[0])
        if self.knn_exclude_self:
            reward = self._distance_to_others(latents, rows, candidates)
        else:
            reward = knn_distance(latents, self.queue, k=self.knn_k)
        if self.reward_norm == "rms":
            self.reward_square_sum.add_(reward.double().square().sum())
            self.reward_count.add_(reward.numel())
            mean_square = self.reward_square_sum / self.reward_count
            reward = reward / mean_square.sqrt().clamp_min(1e-8).to(reward.dtype)
        return reward

    def _distance_to_others(self, latents: Tensor, rows: Tensor, candidates: Tensor) -> Tensor:
        distances = torch.cdist(latents, self.queue)
        # Copies of a sample made by this call are infinitely far from it.
        distances[candidates, rows] = torch.inf
        nearest = distances.topk(self.knn_k, dim=-1, largest=False)
        # The matrix product in cdist cannot resolve small distances: take this one again from the difference.
        kth = (latents - self.queue[nearest.indices[:, -1]]).norm(dim=-1)
        # Too few other entries (tiny batches in a tiny queue): no estimate, no bonus.
        return torch.where(nearest.values[:, -1].isinf(), torch.zeros_like(kth), kth)

    def _bonus(self, features: Tensor, root: TensorDictBase) -> Tensor:
        return self.intrinsic_reward(features)


def _check_latents(length: int, expected: int) -> None:
    if length != expected:
        raise ValueError(
            f"projections have length {length}, the prototypes {expected}; use the projector they were trained with."
        )


def warn_if_mostly_zero(num_prototypes: int, batch_size: int, knn_k: int) -> None:
    """Say so where most rows will earn nothing.

    Every prototype draws a candidate from the batch: from a small one each row so often that the k nearest candidates
    of most rows are the row itself. A row is drawn about Poisson(M / B) times, whose median is k from M / B = k - 1/3
    on. With 512 prototypes, k = 3 and batches of 128 three quarters of the rows get 0.

    Args:
        num_prototypes: M.
        batch_size: B; the paper has B = M.
        knn_k: k.
    """
    too_few = int(num_prototypes / (knn_k - 1 / 3))
    if batch_size <= too_few:
        logger.warning(
            "The prototype reward will mostly be 0: %d prototypes draw their candidates from batches of %d, so that "
            "the %d nearest candidates of a row are the row itself. Take batches of more than %d, or fewer prototypes.",
            num_prototypes, batch_size, knn_k, too_few,
        )  # fmt: skip


def draw_candidates(logits: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw one sample per prototype with probability softmax over the batch.

    By inversion of the cumulative distribution: one uniform number per prototype, no host synchronisation.

    Args:
        logits: ``[M, B]``.
        generator: source of the draws, on any device; the global generator of the logits' device when None.

    Returns:
        int64 ``[M]`` in ``{0, ..., B - 1}``.
    """
    cumulative = logits.softmax(dim=-1).cumsum(dim=-1)
    source = logits.device if generator is None else generator.device
    uniform = torch.rand(logits.shape[0], 1, generator=generator, device=source).to(logits.device)
    drawn = torch.searchsorted(cumulative, uniform * cumulative[:, -1:], right=True)
    # Rounding may carry a draw just below 1 past the last sample.
    return drawn.squeeze(-1).clamp_max(logits.shape[1] - 1)

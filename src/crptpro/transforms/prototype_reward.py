"""The exploration bonus of CRPTpro: how far a new state is from what the prototypes recently picked."""

from __future__ import annotations

import logging
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn

from crptpro.modules.heads import latent_dim_of
from crptpro.objectives.functional import knn_distance
from crptpro.transforms.base import IntrinsicReward
from crptpro.values import as_int

logger = logging.getLogger(__name__)


class PrototypeReward(IntrinsicReward):
    r"""Add the prototype-kNN exploration bonus to the reward (CRPTpro, Eq. 10-11).

    .. math:: r = r_\mathrm{ext} + \beta \hat r

    With :math:`z_i` the l2-normalised projections of a batch of next observations and :math:`c_j` the
    l2-normalised prototypes, each call

    1. draws one candidate per prototype, :math:`i_j \sim \mathrm{Categorical}_i(\mathrm{softmax}_i(c_j \cdot z_i))`;
    2. puts the M vectors :math:`z_{i_j}` into the first-in-first-out queue Q;
    3. then takes :math:`\hat r_i = \lVert z_i - \mathrm{NN}_k(z_i; Q) \rVert_2`, in [0, 2].

    As in the released agent (liuxin0824/CRPTpro ``proto.py``), copies of a sample that were just drawn
    count as neighbours, so a sample drawn k times or more gets exactly 0 (about 8 % of a batch of 512 with
    512 prototypes and k = 3), and rows of the queue not yet filled are zero vectors at distance 1. A row that is not
    finite is never drawn.

    The candidates come from the batch at hand: one sample alone fills the queue with itself and earns 0. Never put it
    on evaluation environments.

    Deviation: the released pre-training fills Q on the way and hands it over; here Q starts from zeros unless ``queue``
    is given.

    Args:
        projector: maps features to the latent space, frozen; None if ``in_keys`` already names projections.
        prototypes: :class:`~crptpro.modules.Prototypes`, rows of any length.
        coef: :math:`\beta`; None writes :math:`\hat r` only.
        knn_k: k, counted with copies of the sample itself.
        queue_size: length of Q, a multiple of M.
        queue: ``[queue_size, D]`` to start from, such as a checkpoint's, the row that is overwritten first in front;
            zeros when None.
        generator: source of the draws; the global generator of the device when None. Not part of the state
            dict.
        **keys: ``in_keys``, ``out_keys`` and ``reward_key`` of :class:`~crptpro.transforms.base.IntrinsicReward`.

    Raises:
        ValueError: a queue size that is no multiple of M, a queue of another shape, more than one key, a ``knn_k``
            that does not lie in 1 to ``queue_size``, or a projector whose outputs are not as long as the prototypes.
    """

    projector: nn.Module | None
    prototypes: nn.Module
    queue: Tensor
    queue_pointer: Tensor

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
            raise ValueError(
                f"queue_size must be a multiple of num_prototypes, got {queue_size} and {num_prototypes}."
            )
        if queue is not None and queue.shape != (queue_size, latent_dim):
            raise ValueError(
                f"expected a queue of shape {(queue_size, latent_dim)}, got {tuple(queue.shape)}."
            )
        told = None if projector is None else latent_dim_of(projector)
        if told is not None:
            _check_latents(told, latent_dim)
        super().__init__({"projector": projector, "prototypes": prototypes}, coef=coef, **keys)
        self.knn_k = as_int(knn_k, "knn_k", minimum=1, maximum=queue_size)
        self.generator = generator
        start = torch.zeros(queue_size, latent_dim) if queue is None else queue
        self.register_buffer("queue", start.detach().to(weight.device, torch.float32, copy=True))
        self.register_buffer("queue_pointer", torch.tensor(0, device=weight.device))

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
        weight = self.prototypes.get_parameter("weight")
        candidates = draw_candidates(F.normalize(weight.float(), dim=-1) @ latents.T, self.generator)
        count = candidates.shape[0]
        rows = (self.queue_pointer + torch.arange(count, device=latents.device)) % self.queue.shape[0]
        self.queue.index_copy_(0, rows, latents[candidates])
        self.queue_pointer.add_(count).remainder_(self.queue.shape[0])
        return knn_distance(latents, self.queue, k=self.knn_k)

    def _intrinsic_reward(self, features: Tensor, tensordict: TensorDictBase) -> Tensor:
        return self.intrinsic_reward(features)


def _check_latents(length: int, expected: int) -> None:
    if length != expected:
        raise ValueError(
            f"projections have length {length}, the prototypes {expected}; use the projector they were trained with."
        )


def warn_if_mostly_zero(num_prototypes: int, batch_size: int, knn_k: int) -> None:
    """Say so where most rows will earn nothing.

    Every prototype draws a candidate from the batch. A row is drawn about Poisson(M / B) times, whose median is k from
    M / B = k - 1/3 on: with 512 prototypes, k = 3 and batches of 128 three quarters of the rows get 0.

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
        logits: ``[M, B]``; samples with NaN are never drawn.
        generator: source of the draws, on any device; the global generator of the logits' device when None.

    Returns:
        int64 ``[M]`` in ``{0, ..., B - 1}``.
    """
    cumulative = logits.masked_fill(logits.isnan(), -torch.inf).softmax(dim=-1).cumsum(dim=-1)
    source = logits.device if generator is None else generator.device
    uniform = torch.rand(logits.shape[0], 1, generator=generator, device=source).to(logits.device)
    # Rounding must not carry a draw just below 1 past the last sample that can be drawn.
    target = torch.minimum(
        uniform * cumulative[:, -1:], torch.nextafter(cumulative[:, -1:], -uniform.new_ones(()))
    )
    drawn = torch.searchsorted(cumulative, target, right=True)
    return drawn.squeeze(-1).clamp_max(logits.shape[1] - 1)

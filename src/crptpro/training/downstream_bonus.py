"""The exploration bonus of a downstream run, from what its artifact brings."""

from __future__ import annotations

import logging

import torch
from torch import Tensor, nn

from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import PretrainedError
from crptpro.pretrained import Pretrained
from crptpro.transforms import PrototypeReward
from crptpro.transforms.prototype_reward import warn_if_mostly_zero

logger = logging.getLogger(__name__)


def require_queue(pretrained: Pretrained, config: DownstreamConfig) -> None:
    """Refuse an artifact whose candidates do not fit the queue that is asked for.

    Raises:
        PretrainedError: naming both lengths.
    """
    has_bonus = pretrained.prototypes is not None and pretrained.projector is not None
    if pretrained.queue is None or config.reset_queue or not has_bonus or not config.intrinsic_reward_coef:
        return
    rows = len(pretrained.queue)
    if rows != config.queue_size:
        raise PretrainedError(
            f"The artifact brings a queue of {rows} candidates, `queue_size` is {config.queue_size}. Set "
            f"queue_size={rows} to go on with them, or reset_queue=True to start with an empty queue."
        )


def build_bonus(
    projector: nn.Module | None,
    prototypes: nn.Module | None,
    queue: Tensor | None,
    config: DownstreamConfig,
    generator: torch.Generator,
    *,
    reads_projections: bool,
) -> PrototypeReward | None:
    """Build the bonus, if one is asked for and the artifact has prototypes.

    Args:
        projector: frozen.
        prototypes: frozen.
        queue: candidates of the pre-training, ``[queue_size, D]``; see :func:`require_queue`.
        config: weight, neighbours and queue.
        generator: draws the candidates.
        reads_projections: whether batches bring projections; features otherwise.
    """
    if config.intrinsic_reward_coef == 0:
        return None
    if prototypes is None or projector is None:
        logger.info("no exploration bonus: the artifact has no prototypes")
        return None
    warn_if_mostly_zero(len(prototypes.get_parameter("weight")), config.batch_size, config.knn_k)
    return PrototypeReward(
        None if reads_projections else projector,
        prototypes,
        in_keys="embedding" if reads_projections else "features",
        intrinsic_reward_coef=config.intrinsic_reward_coef,
        knn_k=config.knn_k,
        queue_size=config.queue_size,
        queue=None if config.reset_queue else queue,
        generator=generator,
    )

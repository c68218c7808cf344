"""Whether a downstream run starts from the actor that explored while the encoder was pre-trained (Proto-RL)."""

from __future__ import annotations

import copy
import logging
from contextlib import suppress

from crptpro.domains import get_domain
from crptpro.downstream_config import SACSettings
from crptpro.errors import PretrainedError, UnknownNameError
from crptpro.modules import SquashedGaussianActor
from crptpro.pretrained import Pretrained

logger = logging.getLogger(__name__)


def transferred_actor(
    task: str, pretrained: Pretrained, config: SACSettings, *, action_dim: int
) -> SquashedGaussianActor | None:
    """Return a trainable copy of the artifact's actor if the run is to start from it.

    Left to itself a run of rad-sac does so where the artifact brings an actor that explored the task's own domain.

    Args:
        task: what is learned.
        pretrained: artifact.
        config: ``transfer_actor`` and ``algorithm``.
        action_dim: of the task.

    Raises:
        PretrainedError: it was asked for, and there is no actor, or it does not fit task or algorithm.
    """
    if config.transfer_actor is False:
        return None
    explored = _explored_domain(pretrained)
    reason = None
    if config.algorithm != "rad-sac":
        reason = f"{config.algorithm} has an actor of another kind"
    elif pretrained.actor is None:
        reason = f"the artifact ({pretrained.method}) has no actor"
    elif not isinstance(pretrained.actor, SquashedGaussianActor):
        reason = f"its actor is a {type(pretrained.actor).__name__}"
    elif (found := pretrained.actor.config["action_dim"]) != action_dim:
        reason = f"its actor has {found} actions, {task} has {action_dim}"
    if reason is None and config.transfer_actor is None and explored != _domain(task):
        reason = f"its actor explored {explored}"
    if reason is not None:
        if config.transfer_actor:
            raise PretrainedError(
                f"transfer_actor was asked for, but {reason}. Leave it out, or use another artifact."
            )
        return None
    assert isinstance(pretrained.actor, SquashedGaussianActor)
    widths = {name: pretrained.actor.config[name] for name in ("bottleneck_dim", "hidden_dim")}
    logger.info(
        "actor: goes on from the one that explored %s (%s), without a random phase",
        explored, ", ".join(f"{name} {width}" for name, width in widths.items()),
    )  # fmt: skip
    return copy.deepcopy(pretrained.actor).requires_grad_(True).train()


def _explored_domain(pretrained: Pretrained) -> str | None:
    training = pretrained.card.get("training") or {}
    names = [facts.get("domain") for facts in training.get("datasets", ())]
    return names[0] if len(names) == 1 else None


def _domain(task: str) -> str:
    with suppress(UnknownNameError):  # only a caller's own factory knows the task
        return get_domain(task).name
    return task

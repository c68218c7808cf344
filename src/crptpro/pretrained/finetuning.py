"""Continuing from an artifact: the loss rebuilt from its card, then trained on."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from torchrl.objectives import LossModule

from crptpro.artifact import TRIMMED_FROM
from crptpro.errors import PretrainedError
from crptpro.objectives import get_method, methods
from crptpro.pretrained.bundle import ROLES, TARGET_ROLES, Pretrained
from crptpro.pretrained.loading import load_pretrained
from crptpro.pretrained.networks import target_state
from crptpro.pretrained.snapshots import IS_SNAPSHOT


def finetune(
    artifact: str | Path | Pretrained,
    datasets: Any,
    *,
    updates: int,
    optimizer_state_from: str | Path | None = None,
    **options: Any,
) -> tuple[Any, Any]:
    """Continue pre-training from an artifact, usually on one more domain.

    The loss is rebuilt from the card; Adam starts afresh, unless ``optimizer_state_from`` says otherwise, and the
    target networks are kept (the paper states neither). The paper's budgets: pendulum 2,000 updates, manipulation
    2,000, cartpole 3,000, cheetah 1,000, walker 500.

    Args:
        artifact: directory, or loaded artifact.
        datasets: as of :func:`~crptpro.training.pretrain`: one dataset or several.
        updates: encoder updates of the fine-tuning.
        optimizer_state_from: run directory of the pre-training that the artifact comes from, whose Adam moments the
            fine-tuning goes on with; learning rate and every other setting are the fine-tuning's own. ``None``: a
            fresh Adam.
        **options: further arguments of :func:`~crptpro.training.pretrain`.

    Returns:
        The loss, ready for :func:`save_pretrained`, and the :class:`~crptpro.training.PretrainResult`.

    Raises:
        PretrainedError: if the artifact's method cannot be rebuilt.
        CheckpointError: if ``optimizer_state_from`` has no checkpoint of a pre-training that ended with the
            artifact's weights.
    """
    # Imported here: the training package imports this module for its downstream half.
    from crptpro.training.pretrain import pretrain

    pretrained = artifact if isinstance(artifact, Pretrained) else load_pretrained(artifact)
    loss = rebuild_loss(pretrained)
    result = pretrain(loss, datasets, updates=updates, optimizer_state_from=optimizer_state_from, **options)
    return loss, result


def rebuild_loss(pretrained: Pretrained) -> LossModule:
    """Build the loss an artifact was trained with, weights and targets included, trainable again.

    The artifact itself stays as it is.

    Raises:
        PretrainedError: if its method is not registered, or does not take the stored networks, or if it is a snapshot
            or a trimmed one, without all of them.
    """
    pretrained = copy.deepcopy(pretrained)  # training must not move the networks somebody else holds
    card = pretrained.card
    if card.get(IS_SNAPSHOT) or TRIMMED_FROM in card:
        was, whole = (
            ("trimmed to what learning a task reads", "it comes from")
            if TRIMMED_FROM in card
            else ("kept along a training, to be read", "that the run ended with")
        )
        raise PretrainedError(
            f"The artifact was {was}: it lacks the networks that training goes on with. Take the one {whole}."
        )
    if pretrained.method not in methods(presets=True):
        raise PretrainedError(
            f"The artifact was trained with {pretrained.method!r}, which is no registered method. Call "
            "crptpro.objectives.register_method for its loss first."
        )
    method = get_method(pretrained.method)
    networks = {
        role: getattr(pretrained, role) for role in ROLES[1:] if getattr(pretrained, role) is not None
    }
    for module in (pretrained.encoder, *networks.values()):
        module.requires_grad_(True).train()
    options = dict(card.get("loss", {}).get("config", {}))
    try:
        loss = method.loss_class(pretrained.encoder, **networks, **options)
        loss.load_state_dict(pretrained.rest, strict=False)
    except (TypeError, RuntimeError) as reason:
        raise PretrainedError(
            f"{method.loss_class.__name__} cannot be rebuilt from the artifact: {reason}"
        ) from reason
    loss.method_name = method.name
    for target in TARGET_ROLES:
        module = getattr(pretrained, target)
        if module is not None:
            for key, live in target_state(loss, target.removeprefix("target_")).items():
                live.copy_(module.state_dict()[key])
    loss.started_from = pretrained.identity()
    loss.previous_training = card.get("training")
    return loss

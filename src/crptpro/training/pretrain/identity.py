"""What identifies a pre-training run: all that must agree for a checkpoint to be continued."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from crptpro.modules import is_channels_last
from crptpro.objectives import method_defaults
from crptpro.training.fingerprint import describe_loss
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.turns import Turns


def identity_of(
    learner: Learner,
    turns: Turns,
    settings: Mapping[str, Any],
    *,
    precision: str,
) -> dict[str, Any]:
    """Return everything that decides a run's numbers.

    Args:
        learner: does the updates.
        turns: makes the batches.
        settings: ``updates``, ``batch_size`` and ``seed``.
        precision: as resolved.
    """
    defaults = learner.defaults
    # Only where used: older runs can be continued.
    switches: dict[str, Any] = {"compile": True} if learner.compiled.is_on else {}
    if not is_channels_last(learner.loss):
        switches["channels_last"] = False
    if turns.batches is not None:
        switches["batches"] = "drawn on the device"
    if turns.schedule != "cycle":
        switches["domain_schedule"] = turns.schedule
    if learner.moments_digest is not None:
        switches["optimizer_state"] = f"kept {learner.moments_digest}"
    usual = 0 if defaults.schedule == "constant" else method_defaults(learner.loss).warmup_updates
    if defaults.warmup_updates != usual:
        switches["warmup_updates"] = defaults.warmup_updates
    return {
        "batch_size": settings["batch_size"],
        "learning_rate": learner.learning_rate,
        "betas": list(defaults.betas),
        "eps": defaults.eps,
        "weight_decay": defaults.weight_decay,
        "grad_clip": defaults.grad_clip,
        "schedule": defaults.schedule,
        # A schedule is stretched over the run, so a run with one cannot be extended.
        "updates": None if defaults.schedule == "constant" else settings["updates"],
        "encoder_tau": learner.encoder_tau,
        "seed": settings["seed"],
        "augment": turns.augmenter.name,
        "precision": precision,
        **switches,
        "loss": describe_loss(learner.loss),
        "datasets": [source.identity() for source in turns.sources],
    }

"""Adam's moments of an earlier pre-training, for one that goes on from its weights."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule

from crptpro.errors import CheckpointError
from crptpro.training.checkpoint import CHECKPOINTS, CheckpointDir

Moments = Mapping[int, Mapping[str, Tensor]]
"""``step`` (a scalar), ``exp_avg`` and ``exp_avg_sq`` (of the parameter's shape), by the parameter's number."""


def read_moments(run_dir: str | Path, loss: LossModule) -> Moments:
    """Read the moments that a pre-training on datasets, or an exploring one, left in its newest checkpoint.

    Args:
        run_dir: directory of that run.
        loss: what is trained next, with the weights that the run ended with.

    Raises:
        CheckpointError: if there is no such checkpoint, or the moments are those of other parameters or weights.
    """
    run_dir = Path(run_dir)
    remedy = (
        "Name the run directory that the pretrained encoder comes from, or leave it out for a fresh Adam."
    )
    state = CheckpointDir(run_dir / CHECKPOINTS).load_latest()
    if state is None:
        parent = run_dir.absolute().parent
        is_inside = CheckpointDir(parent / CHECKPOINTS).latest_counter() is not None
        hint = f" Did you mean {parent}?" if is_inside else ""
        raise CheckpointError(
            f"`optimizer_state_from`: {run_dir} is no run directory with checkpoints.{hint} {remedy}"
        )
    learner = state.get("learner")
    if not isinstance(learner, Mapping) or not {"loss", "optimizer"} <= learner.keys():
        raise CheckpointError(
            f"`optimizer_state_from`: the checkpoints in {run_dir} are no pre-training's. {remedy}"
        )
    if differing := _difference(learner, loss):
        raise CheckpointError(f"`optimizer_state_from`: the run in {run_dir} {differing}. {remedy}")
    return learner["optimizer"]["state"]


def digest_of(moments: Moments) -> str:
    """Return what tells moments from any others."""
    digest = hashlib.sha256()
    for number, values in sorted(moments.items()):
        for name, value in sorted(values.items()):
            digest.update(f"{number}.{name}".encode())
            digest.update(value.detach().cpu().float().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def load_moments(optimizer: torch.optim.Optimizer, moments: Moments) -> None:
    """Give Adam the moments of an earlier one; learning rate and every other setting stay its own.

    Args:
        optimizer: with one group of parameters, in the order of the earlier one's.
        moments: by the number of the parameter; those without go on afresh.
    """
    parameters = optimizer.param_groups[0]["params"]
    state = {
        number: {
            # Fused Adam walks parameter and moment through memory side by side, whatever their strides say.
            name: torch.empty_like(parameters[number]).copy_(value) if value.ndim else value
            for name, value in values.items()
        }
        for number, values in moments.items()
    }
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _difference(learner: Mapping[str, Any], loss: LossModule) -> str:
    """Say what keeps a run's moments from belonging to a loss; empty if nothing does."""
    saved = learner["loss"]
    parameters = {name: p.detach() for name, p in loss.named_parameters() if p.requires_grad}
    for name, value in parameters.items():
        if name not in saved:
            return f"did not train {name}, which is trained now"
        if saved[name].shape != value.shape:
            return f"trained {name} of shape {tuple(saved[name].shape)}, now it has {tuple(value.shape)}"
    numbers = learner["optimizer"]["param_groups"][0]["params"]
    if len(numbers) != len(parameters) or [name for name in saved if name in parameters] != list(parameters):
        return f"trained {len(numbers)} parameters, now there are {len(parameters)}, or in another order"
    for name, value in parameters.items():
        if not torch.equal(saved[name], value.cpu()):
            return f"ended with other weights than training goes on from (first of them {name})"
    return ""

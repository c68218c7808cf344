"""Reaching the networks of a loss, whichever way it holds them."""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictModule
from torch import Tensor, nn


def unwrap(module: Any) -> nn.Module | None:
    """The network inside a ``TensorDictModule``, or the network itself; ``None`` for anything else."""
    while isinstance(module, TensorDictModule):
        module = module.module
    return module if isinstance(module, nn.Module) else None


def target_state(loss: Any, role: str) -> dict[str, Tensor]:
    """The live tensors of a target network by state-dict name; empty if there is none."""
    if isinstance(module := unwrap(getattr(loss, f"target_{role}", None)), nn.Module):
        return {key: value.detach() for key, value in module.state_dict(keep_vars=True).items()}
    params = getattr(loss, "_modules", {}).get(f"target_{role}_params")
    if params is None:
        return {}
    named = {".".join(k) if isinstance(k, tuple) else k: v.data for k, v in params.items(True, True)}
    is_wrapped = isinstance(getattr(loss, role, None), TensorDictModule)
    return {key.removeprefix("module.") if is_wrapped else key: value for key, value in named.items()}

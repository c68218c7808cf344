"""One user seed, many independent streams: derivation, global seeding, and RNG state as plain values."""

from __future__ import annotations

import hashlib
import random
from typing import Any

import numpy as np
import torch


def derive_seed(seed: int, *path: str | int) -> int:
    """Derive a seed in ``[0, 2**31)`` from ``seed`` and a path of names, stable across processes.

    Streams with different paths are independent, so the number of workers, or the order in which
    episodes are collected, never changes what one episode looks like.

    Examples:
        >>> derive_seed(0, "collect", "walker", 3) == derive_seed(0, "collect", "walker", 3)
        True
        >>> derive_seed(0, "a", 1) == derive_seed(0, "a1")
        False
    """
    text = "/".join([str(int(seed)), *(f"{type(part).__name__}:{part}" for part in path)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little") & 0x7FFFFFFF


def seed_everything(seed: int) -> None:
    """Seed Python's, NumPy's and torch's global generators (all devices)."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - dm_control and gymnasium read the legacy global generator
    torch.manual_seed(seed)


def global_rng_state() -> dict[str, Any]:
    """Return torch's global generator states (CPU, and CUDA where in use) as tensors."""
    state: dict[str, Any] = {"torch": torch.get_rng_state()}
    if torch.cuda.is_initialized():  # asking an unused GPU would take its memory
        state["cuda"] = torch.cuda.get_rng_state_all()
    return state


def set_global_rng_state(state: dict[str, Any]) -> None:
    """Restore what :func:`global_rng_state` returned, on as many GPUs as there are."""
    torch.set_rng_state(state["torch"].cpu())
    for device in range(min(len(state.get("cuda", ())), torch.cuda.device_count())):
        torch.cuda.set_rng_state(state["cuda"][device].cpu(), device)

"""One user seed, many independent streams: derivation, global seeding, and RNG state as plain values."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from crptpro.errors import CRPTproError


def require_seed(seed: int) -> None:
    """Refuse a seed that no generator takes.

    Raises:
        CRPTproError: outside [0, 2**32), NumPy's range.
    """
    if not 0 <= seed < 2**32:
        raise CRPTproError(f"`seed` must be from 0 to {2**32 - 1}, got {seed}.")


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
    """Seed Python's, NumPy's and torch's global generators (all devices).

    Raises:
        CRPTproError: a seed outside [0, 2**32).
    """
    require_seed(seed)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - dm_control and gymnasium read the legacy global generator
    torch.manual_seed(seed)


def global_rng_state() -> dict[str, Any]:
    """Return the states of Python's, NumPy's and torch's global generators (CPU, and CUDA where in use).

    Torch's are tensors, the others plain numbers and texts: a checkpoint holds them.
    """
    state: dict[str, Any] = {
        "python": random.getstate(),
        "numpy": _plain(np.random.get_state(legacy=False)),  # noqa: NPY002 - the one that worlds draw from
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_initialized():  # asking an unused GPU would take its memory
        state["cuda"] = torch.cuda.get_rng_state_all()
    return state


def set_global_rng_state(state: dict[str, Any]) -> None:
    """Restore what :func:`global_rng_state` returned, on as many GPUs as there are."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"].cpu())
    for device in range(min(len(state.get("cuda", ())), torch.cuda.device_count())):
        torch.cuda.set_rng_state(state["cuda"][device].cpu(), device)


@contextmanager
def kept_global_rng() -> Iterator[None]:
    """Leave the global generators as they were found, whatever is seeded and drawn inside.

    Examples:
        >>> seed_everything(0)
        >>> with kept_global_rng():
        ...     seed_everything(1)
        >>> inside = random.random()
        >>> seed_everything(0)
        >>> random.random() == inside
        True
    """
    state = global_rng_state()
    try:
        yield
    finally:
        set_global_rng_state(state)


def _plain(value: Any) -> Any:
    """Turn the arrays in NumPy's state into lists, which NumPy takes back as they are."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value

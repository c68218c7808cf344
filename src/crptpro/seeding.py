"""Independent seeds from one user seed, and the global generators of Python, NumPy and torch."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torchrl.checkpoint import GlobalRNGState

from crptpro.values import MAX_SEED, as_int


def derive_seed(seed: int, *path: str | int) -> int:
    """Derive a seed in ``[0, 2**31)`` from ``seed`` and a path of names, the same in every process.

    Streams of different paths are independent.

    Examples:
        >>> derive_seed(0, "collect", "walker", 3) == derive_seed(0, "collect", "walker", 3)
        True
        >>> derive_seed(0, "a", 1) == derive_seed(0, "a1")
        False
    """
    text = "/".join([str(int(seed)), *(f"{type(part).__name__}:{part}" for part in path)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little") & 0x7FFFFFFF


def seed_everything(seed: int) -> None:
    """Seed Python's, NumPy's and torch's global generators (all devices) with a seed from 0 to 2**32 - 1."""
    seed = as_int(seed, "seed", minimum=0, maximum=MAX_SEED)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - dm_control and gymnasium read the legacy global generator
    torch.manual_seed(seed)


@contextmanager
def kept_global_rng() -> Iterator[None]:
    """Restore the global generators at the end of a ``with`` block."""
    state = GlobalRNGState().state_dict()
    try:
        yield
    finally:
        GlobalRNGState().load_state_dict(state)

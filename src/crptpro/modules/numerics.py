"""How the networks inside a module compute, for as long as something lasts."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import nn

from crptpro.modules.layout import set_channels_last
from crptpro.modules.precision import set_compute_dtype


@contextlib.contextmanager
def computing(module: nn.Module, dtype: torch.dtype, *, channels_last: bool) -> Iterator[None]:
    """Have networks compute in a dtype and a layout, and afterwards as freshly built ones do.

    Args:
        module: a network, or a loss that owns networks.
        dtype: as for :func:`~crptpro.modules.set_compute_dtype`; float32 afterwards.
        channels_last: as for :func:`~crptpro.modules.set_channels_last`; on afterwards.
    """
    try:
        set_channels_last(set_compute_dtype(module, dtype), channels_last)
        yield
    finally:
        set_channels_last(set_compute_dtype(module, torch.float32), True)

"""Whether somebody watches or changes tensor operations as they are called."""

from __future__ import annotations

import torch
from torch.utils._python_dispatch import is_in_torch_dispatch_mode


def is_watched() -> bool:
    """Whether autocast, a compiler, tracing, a dispatch mode or ``torch.func`` is at work here.

    They follow the operations of the thread that they are in, and know the public ones.
    """
    return (
        torch.compiler.is_compiling()
        or torch.jit.is_tracing()
        or torch.is_autocast_enabled("cpu")
        or is_in_torch_dispatch_mode()
        or torch._C._are_functorch_transforms_active()
    )

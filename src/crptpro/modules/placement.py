"""Where a network lives."""

from __future__ import annotations

from itertools import chain

import torch
from torch import nn


def device_of(module: nn.Module) -> torch.device | None:
    """Return the device of a network's first parameter or buffer; None if it has neither.

    Examples:
        >>> device_of(nn.Linear(2, 2)), device_of(nn.ReLU())
        (device(type='cpu'), None)
    """
    first = next(chain(module.parameters(), module.buffers()), None)
    return None if first is None else first.device

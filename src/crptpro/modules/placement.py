"""Where a network lives, or can live."""

from __future__ import annotations

from itertools import chain

import torch
from torch import nn

from crptpro.errors import CRPTproError


def device_of(module: nn.Module) -> torch.device | None:
    """Return the device of a network's first parameter or buffer; None if it has neither.

    Examples:
        >>> device_of(nn.Linear(2, 2)), device_of(nn.ReLU())
        (device(type='cpu'), None)
    """
    first = next(chain(module.parameters(), module.buffers()), None)
    return None if first is None else first.device


def usable_device(name: str | torch.device) -> torch.device:
    """Return a device, once a tensor could be put there.

    Raises:
        CRPTproError: with torch's reason, if this machine or this build of torch has no such device.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as reason:
        raise CRPTproError(
            f"Device {str(name)!r} cannot be used ({str(reason).splitlines()[0]}); 'cpu' always works."
        ) from None
    return device

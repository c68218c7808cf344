"""What both trainings say and check when numbers stop being finite."""

from __future__ import annotations

import torch
from torch import nn

from crptpro.errors import NonFiniteError


def not_finite(what: str) -> NonFiniteError:
    """Return the error that ends a diverged run: what happened, what is kept, and the remedy."""
    return NonFiniteError(
        f"{what}. Training stopped and the last checkpoint is kept. "
        "Lower the learning rate, use precision='fp32', or check the data."
    )


def require_finite_parameters(module: nn.Module, updates: int) -> None:
    """Refuse to keep a network whose last update spoilt a parameter that no metric has shown yet.

    Args:
        module: the network, or a loss with its networks.
        updates: updates done, for the message.

    Raises:
        NonFiniteError: naming the first parameter with a NaN or an infinity.
    """
    for name, parameter in module.named_parameters():
        if not torch.isfinite(parameter.detach().sum()) and not torch.isfinite(parameter.detach()).all():
            raise not_finite(f"After update {updates} the parameter {name} is not finite")

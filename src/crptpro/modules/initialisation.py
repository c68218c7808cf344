"""How weights are drawn."""

from __future__ import annotations

from typing import Literal, get_args

from torch import nn

WeightInit = Literal["orthogonal", "kaiming"]


def init_weights_(layer: nn.Linear | nn.Conv2d, init: WeightInit, gain: float = 1.0) -> None:
    """Initialise a layer in place, with zero bias.

    Args:
        layer: linear or convolutional.
        init: ``"orthogonal"`` on the flattened kernel, or ``"kaiming"``: normal with variance 2 / fan-in, for
            layers that a ReLU follows (rlpyt, the framework of ATC).
        gain: of the orthogonal matrix.
    """
    if init == "kaiming":
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    else:
        nn.init.orthogonal_(layer.weight, gain=gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def orthogonal_linear_(linear: nn.Linear, gain: float = 1.0) -> None:
    """Initialise a linear layer in place: orthogonal weight, zero bias."""
    init_weights_(linear, "orthogonal", gain)


def require_weight_init(init: str) -> None:
    """Refuse a name that is none of :data:`WeightInit`.

    Raises:
        ValueError: naming the known ones.
    """
    if init not in get_args(WeightInit):
        raise ValueError(f"init must be one of {', '.join(get_args(WeightInit))}, got {init!r}.")

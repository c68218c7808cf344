"""The methods that come with the library."""

from __future__ import annotations

from crptpro.objectives.proto import ProtoLoss
from crptpro.objectives.registry import MethodDefaults, register_method

register_method("crptpro", ProtoLoss, MethodDefaults())
# The authors' published code where it differs from the paper: predictor width, and 3 x 16,666 updates.
register_method(
    "released-code",
    ProtoLoss,
    MethodDefaults(updates=49_998),
    loss_options={"hidden_dim": 512},
    is_preset=True,
)

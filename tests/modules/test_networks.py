"""What all networks have in common: initialisation, products in bfloat16, and a config that rebuilds them."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from crptpro.modules import (
    AnchorHead,
    DeterministicActor,
    PixelEncoder,
    Predictor,
    Projector,
    Prototypes,
    SkillHead,
    SquashedGaussianActor,
    TwinCritic,
    computing,
)

SMALL = {"bottleneck_dim": 10, "hidden_dim": 32}
ACTOR, CRITIC = SquashedGaussianActor(400, 3, **SMALL), TwinCritic(400, 3, **SMALL)
SKILLED = DeterministicActor(40, 3, skill_dim=4, **SMALL)
OF_TWO_SIZES = [Projector, Predictor, Prototypes, AnchorHead, SkillHead, SquashedGaussianActor, TwinCritic]


@pytest.mark.parametrize("network", [Projector(50, 8), Predictor(16, 64), SkillHead(50, 4, 8), ACTOR, CRITIC, SKILLED])
def test_linear_layers_are_orthogonal_with_zero_bias(network: nn.Module) -> None:
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            wide = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
            torch.testing.assert_close(wide @ wide.T, torch.eye(len(wide)), rtol=0, atol=1e-5)
            assert not layer.bias.any()


@pytest.mark.parametrize("make", [lambda init: Projector(2_000, 64, init), lambda init: PixelEncoder(init=init)])
def test_kaiming_weights_have_the_variance_two_over_fan_in(make) -> None:
    for layer in make("kaiming").modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d)):
            fan_in = layer.weight[0].numel()
            assert layer.weight.std().item() == pytest.approx((2 / fan_in) ** 0.5, rel=0.06)
            assert not layer.bias.any()
    with pytest.raises(ValueError, match="init must be one of orthogonal, kaiming, got 'xavier'"):
        make("xavier")


@pytest.mark.parametrize(
    ("network", "inputs", "tolerance"),
    [
        (Projector(2000, 16), [2000], 0.02),
        (SkillHead(2000, 4, 16), [2000], 0.02),
        (ACTOR, [400], 0.03),
        (CRITIC, [400, 3], 0.03),
    ],
)
def test_bfloat16_products_are_close_and_return_float32(
    network: nn.Module, inputs: list[int], tolerance: float
) -> None:
    features, *action = (torch.rand(64, length) for length in inputs)

    def output(features: torch.Tensor) -> torch.Tensor:
        found = network(features, *action)
        return found[0] if isinstance(found, tuple) else found

    expected = output(features)
    assert torch.equal(output(features.bfloat16()), output(features.bfloat16().float()))
    with computing(network, torch.bfloat16):
        result = output(features.bfloat16())
    assert result.dtype == torch.float32
    assert 0 < (result - expected).norm() / expected.norm() < tolerance
    result.sum().backward()
    assert all(p.grad.dtype == torch.float32 for p in network.parameters() if p.grad is not None)


@pytest.mark.parametrize(
    "make",
    [
        *OF_TWO_SIZES,
        partial(DeterministicActor, skill_dim=np.int8(4)),
        lambda channels, length: PixelEncoder(channels, channels=np.array([4, length]), strides=(2.0, torch.tensor(1))),
        lambda channels, size: PixelEncoder(channels, image_size=size + 20, pixel_scale=np.float32(0.5)),
    ],
)
def test_sizes_of_any_number_type_become_plain_integers_in_the_card(make: Any) -> None:
    network = make(np.int64(6), torch.tensor(4))
    assert json.loads(json.dumps(network.config)) == network.config
    type(network)(**network.config).load_state_dict(network.state_dict())
    for wrong, message in ((4.5, r"must be a whole number, got .*4\.5"), (-20, "must be at least 1, got")):
        with pytest.raises(ValueError, match=message):
            make(6, wrong)

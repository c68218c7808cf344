"""Heads of pre-training: projector, predictor, prototypes, ATC's anchor head, BeCL's head."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from crptpro.modules import AnchorHead, PixelEncoder, Predictor, Projector, Prototypes, SkillHead


@pytest.mark.parametrize("module", [Projector(50, 8), Predictor(16, 64), SkillHead(50, 4, 8)])
def test_linear_layers_are_orthogonal_with_zero_bias(module: torch.nn.Module) -> None:
    for layer in module.children():
        wide = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
        torch.testing.assert_close(wide @ wide.T, torch.eye(len(wide)))
        assert not layer.bias.any()


@pytest.mark.parametrize("make", [lambda init: Projector(2_000, 64, init), lambda init: PixelEncoder(init=init)])
def test_kaiming_weights_have_the_variance_two_over_fan_in(make) -> None:
    for layer in make("kaiming").modules():
        if isinstance(layer, (torch.nn.Linear, torch.nn.Conv2d)):
            fan_in = layer.weight[0].numel()
            assert layer.weight.std().item() == pytest.approx((2 / fan_in) ** 0.5, rel=0.06)
            assert not layer.bias.any()
    with pytest.raises(ValueError, match="init must be one of orthogonal, kaiming, got 'xavier'"):
        make("xavier")


def test_heads_are_the_published_perceptrons() -> None:
    predictor, x = Predictor(6, 10), torch.randn(3, 6)
    hidden = (x @ predictor.hidden.weight.T + predictor.hidden.bias).clamp_min(0)
    torch.testing.assert_close(predictor(x), hidden @ predictor.output.weight.T + predictor.output.bias)

    anchor = AnchorHead(6, 10)
    hidden = (x @ anchor.hidden.weight.T + anchor.hidden.bias).clamp_min(0)
    residual = x + hidden @ anchor.output.weight.T + anchor.output.bias
    torch.testing.assert_close(anchor(x), residual @ anchor.bilinear.weight.T)
    assert anchor.bilinear.bias is None

    skill, x = SkillHead(20, 4, 8), torch.rand(3, 20)
    widths = [(layer.in_features, layer.out_features) for layer in skill.children()]
    assert widths == [(20, 8), (8, 8), (8, 4), (4, 8), (8, 4)]
    embedded = skill.embed_output(skill.embed_hidden(skill.embed_input(x).relu()).relu())
    torch.testing.assert_close(skill(x), skill.project_output(skill.project_hidden(embedded).relu()))


@pytest.mark.parametrize("head", [Projector(2000, 16), SkillHead(2000, 4, 16)])
def test_bfloat16_products_are_close_and_return_float32(head: torch.nn.Module) -> None:
    features = torch.rand(32, 2000)
    expected = head(features)
    assert torch.equal(head(features.bfloat16()), head(features.bfloat16().float()))
    head.compute_dtype = torch.bfloat16
    result = head(features.bfloat16())
    assert result.dtype == torch.float32
    assert 0 < (result - expected).norm() / expected.norm() < 0.02
    result.sum().backward()
    assert all(p.grad.dtype == torch.float32 for p in head.parameters())


def test_fresh_prototypes_are_a_tight_frame_and_normalize_restores_unit_rows_in_place() -> None:
    torch.manual_seed(0)
    unscaled = torch.nn.init.orthogonal_(torch.empty(64, 16))
    torch.manual_seed(0)
    prototypes = Prototypes(64, 16)
    torch.testing.assert_close(prototypes.weight.detach(), F.normalize(unscaled, dim=1))
    storage = prototypes.weight.data_ptr()
    with torch.no_grad():
        prototypes.weight.mul_(3.0)
    assert prototypes.normalize_() is prototypes
    torch.testing.assert_close(prototypes.weight.detach(), F.normalize(unscaled, dim=1))
    assert prototypes.weight.data_ptr() == storage
    assert prototypes.weight.grad_fn is None


def test_scores_are_cosines_whatever_the_length_of_the_rows_which_is_a_constant_to_the_gradient() -> None:
    prototypes, z = Prototypes(8, 4), F.normalize(torch.randn(5, 4), dim=1)
    expected = prototypes(z)
    torch.testing.assert_close(expected, F.cosine_similarity(z[:, None], prototypes.weight[None], dim=-1))
    target = torch.randn(8, 4)
    (prototypes.unit_weight() * target).sum().backward()
    torch.testing.assert_close(prototypes.weight.grad, target)
    with torch.no_grad():
        prototypes.weight.mul_(torch.rand(8, 1) + 0.5)
    torch.testing.assert_close(prototypes(z), expected)
    with torch.no_grad():
        prototypes.weight[0].zero_()
    assert not prototypes(z)[:, 0].any()


@pytest.mark.parametrize("head", [Projector, Predictor, Prototypes, AnchorHead, SkillHead])
def test_sizes_of_any_number_type_become_plain_integers_in_the_card(head: type[torch.nn.Module]) -> None:
    module = head(np.int64(6), torch.tensor(4))
    assert json.loads(json.dumps(module.config)) == module.config
    type(module)(**module.config).load_state_dict(module.state_dict())
    with pytest.raises(ValueError, match=r"must be a whole number, got 4\.5"):
        head(6, 4.5)

"""Projector, predictor and prototypes."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from crptpro.modules import Predictor, Projector, Prototypes


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameter_counts_are_the_published_ones() -> None:
    assert count(Projector()) == 5_017_728
    assert count(Predictor()) == 263_296
    assert count(Predictor(hidden_dim=512)) == 131_712
    assert count(Prototypes()) == 65_536


def test_linear_layers_are_orthogonal_with_zero_bias() -> None:
    predictor = Predictor(16, 64)
    torch.testing.assert_close(predictor.hidden.weight.T @ predictor.hidden.weight, torch.eye(16))
    torch.testing.assert_close(predictor.output.weight @ predictor.output.weight.T, torch.eye(16))
    weight = Projector(50, 8).linear.weight
    torch.testing.assert_close(weight @ weight.T, torch.eye(8))
    assert not predictor.hidden.bias.any()
    assert not predictor.output.bias.any()


def test_predictor_is_a_two_layer_perceptron() -> None:
    predictor, x = Predictor(6, 10), torch.randn(3, 6)
    hidden = (x @ predictor.hidden.weight.T + predictor.hidden.bias).clamp_min(0)
    torch.testing.assert_close(predictor(x), hidden @ predictor.output.weight.T + predictor.output.bias)


def test_bfloat16_projection_is_close_and_returns_float32() -> None:
    projector, features = Projector(2000, 16), torch.rand(32, 2000)
    expected = projector(features)
    projector.compute_dtype = torch.bfloat16
    result = projector(features.to(torch.bfloat16))
    assert result.dtype == torch.float32
    assert (result - expected).norm() / expected.norm() < 0.01
    result.sum().backward()
    assert projector.linear.weight.grad.dtype == torch.float32


def test_float32_projector_accepts_bfloat16_features() -> None:
    projector, features = Projector(20, 4), torch.rand(3, 20).to(torch.bfloat16)
    assert torch.equal(projector(features), projector(features.float()))


def test_fresh_prototypes_are_a_tight_frame_of_unit_rows() -> None:
    weight = Prototypes(64, 16).weight.detach()
    torch.testing.assert_close(weight.norm(dim=1), torch.ones(64))
    unscaled = torch.empty(64, 16)
    torch.manual_seed(0)
    torch.nn.init.orthogonal_(unscaled)
    torch.manual_seed(0)
    torch.testing.assert_close(Prototypes(64, 16).weight.detach(), F.normalize(unscaled, dim=1))


def test_normalize_restores_unit_length_in_place_and_without_gradient() -> None:
    prototypes = Prototypes(8, 4)
    storage = prototypes.weight.data_ptr()
    with torch.no_grad():
        prototypes.weight.mul_(3.0)
    assert prototypes.normalize_() is prototypes
    torch.testing.assert_close(prototypes.weight.detach().norm(dim=1), torch.ones(8))
    assert prototypes.weight.data_ptr() == storage
    assert prototypes.weight.grad_fn is None


def test_scores_are_cosines_whatever_the_length_of_the_rows() -> None:
    prototypes, z = Prototypes(8, 4), F.normalize(torch.randn(5, 4), dim=1)
    expected = prototypes(z)
    assert expected.abs().max() <= 1 + 1e-6
    with torch.no_grad():
        prototypes.weight.mul_(torch.rand(8, 1) + 0.5)
    torch.testing.assert_close(prototypes(z), expected)
    torch.testing.assert_close(expected, F.cosine_similarity(z[:, None], prototypes.weight[None], dim=-1))


@pytest.mark.parametrize("through_norm", [False, True])
def test_gradient_passes_through_the_normalisation_only_on_request(through_norm: bool) -> None:
    prototypes, target = Prototypes(8, 4), torch.randn(8, 4)
    (prototypes.unit_weight(through_norm=through_norm) * target).sum().backward()
    gradient, unit = prototypes.weight.grad, prototypes.weight.detach()
    radial = (gradient * unit).sum(dim=1)
    if through_norm:
        torch.testing.assert_close(radial, torch.zeros(8), rtol=0, atol=1e-6)
    else:
        torch.testing.assert_close(gradient, target)


def test_a_zero_prototype_scores_zero_instead_of_nan() -> None:
    prototypes = Prototypes(2, 3)
    with torch.no_grad():
        prototypes.weight[0].zero_()
    assert prototypes(torch.ones(1, 3))[0, 0] == 0


@pytest.mark.parametrize("module", [Projector(12, 4), Predictor(4, 8), Prototypes(6, 4)])
def test_config_rebuilds_the_module(module: torch.nn.Module) -> None:
    type(module)(**module.config).load_state_dict(module.state_dict())

"""Heads of pre-training: predictor, prototypes, ATC's anchor head, BeCL's head."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from crptpro.modules import AnchorHead, Predictor, Prototypes, SkillHead


def test_predictor_and_skill_head_have_the_published_layers() -> None:
    predictor, x = Predictor(6, 10), torch.randn(3, 6)
    hidden = (x @ predictor.hidden.weight.T + predictor.hidden.bias).clamp_min(0)
    torch.testing.assert_close(predictor(x), hidden @ predictor.output.weight.T + predictor.output.bias)
    widths = [(layer.in_features, layer.out_features) for layer in SkillHead(20, 4, 8).children()]
    assert widths == [(20, 8), (8, 8), (8, 4), (4, 8), (8, 4)]
    assert AnchorHead(6, 10).bilinear.bias is None


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

"""ATC's anchor head and BeCL's head."""

from __future__ import annotations

import pytest
import torch

from crptpro.modules import AnchorHead, PixelEncoder, Projector, SkillHead


def test_anchor_head_is_a_residual_perceptron_before_a_bilinear_matrix() -> None:
    head, x = AnchorHead(6, 10), torch.randn(3, 6)
    hidden = (x @ head.hidden.weight.T + head.hidden.bias).clamp_min(0)
    residual = x + hidden @ head.output.weight.T + head.output.bias
    torch.testing.assert_close(head(x), residual @ head.bilinear.weight.T)
    assert head.bilinear.bias is None


def test_skill_head_is_an_embedding_before_a_projection() -> None:
    head, x = SkillHead(20, 4, 8), torch.rand(3, 20)
    widths = [(layer.in_features, layer.out_features) for layer in head.children()]
    assert widths == [(20, 8), (8, 8), (8, 4), (4, 8), (8, 4)]
    assert head.config == {"feature_dim": 20, "latent_dim": 4, "hidden_dim": 8}
    y = head.embed_hidden(head.embed_input(x).relu()).relu()
    expected = head.project_output(head.project_hidden(head.embed_output(y)).relu())
    torch.testing.assert_close(head(x), expected)


def test_skill_head_is_orthogonal_with_zero_biases() -> None:
    head = SkillHead(50, 4, 8)
    torch.testing.assert_close(head.embed_input.weight @ head.embed_input.weight.T, torch.eye(8))
    torch.testing.assert_close(head.project_hidden.weight.T @ head.project_hidden.weight, torch.eye(4))
    assert not any(layer.bias.any() for layer in head.children())


def test_skill_head_in_bfloat16_is_close_and_returns_float32() -> None:
    head, features = SkillHead(500, 4, 16), torch.rand(8, 500)
    expected = head(features)
    head.compute_dtype = torch.bfloat16
    result = head(features.to(torch.bfloat16))
    assert result.dtype == torch.float32
    assert 0 < (result - expected).norm() / expected.norm() < 0.02


@pytest.mark.parametrize(
    "make", [lambda init: Projector(2_000, 64, init), lambda init: PixelEncoder(init=init)]
)
def test_kaiming_weights_have_the_variance_two_over_fan_in(make) -> None:
    module = make("kaiming")
    layers = [m for m in module.modules() if isinstance(m, (torch.nn.Linear, torch.nn.Conv2d))]
    for layer in layers:
        fan_in = layer.weight[0].numel()
        assert layer.weight.std().item() == pytest.approx((2 / fan_in) ** 0.5, rel=0.06)
        assert not layer.bias.any()
    assert type(module)(**module.config).init == "kaiming"
    with pytest.raises(ValueError, match="init must be one of orthogonal, kaiming, got 'xavier'"):
        make("xavier")

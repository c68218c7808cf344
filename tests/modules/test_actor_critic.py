"""Actor and critic: arithmetic of the released agents, saturation, initialisation."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from crptpro.modules import SquashedGaussianActor, TwinCritic, set_compute_dtype
from crptpro.modules.actor_critic import squash_log_std, squashed_gaussian


def actor(**options) -> SquashedGaussianActor:
    torch.manual_seed(0)
    return SquashedGaussianActor(40, 3, bottleneck_dim=10, hidden_dim=32, **options)


def critic() -> TwinCritic:
    torch.manual_seed(0)
    return TwinCritic(40, 3, bottleneck_dim=10, hidden_dim=32)


def test_golden_values_of_the_squashed_gaussian() -> None:
    log_std = squash_log_std(torch.tensor([0.2], dtype=torch.float64), (-10, 2))
    action, log_prob = squashed_gaussian(
        torch.tensor([0.3], dtype=torch.float64), log_std.exp(), torch.tensor([0.5], dtype=torch.float64)
    )
    assert log_std.item() == pytest.approx(-2.815748, abs=1e-6)
    assert action.item() == pytest.approx(0.318458, abs=1e-6)
    assert log_prob.item() == pytest.approx(1.878744, abs=1e-6)


def test_log_probability_equals_torch_distributions_away_from_saturation() -> None:
    loc, scale, noise = (
        torch.randn(5, 3).double(),
        torch.rand(5, 3).double() + 0.1,
        torch.randn(5, 3).double(),
    )
    action, log_prob = squashed_gaussian(loc, scale, noise)
    reference = TransformedDistribution(Normal(loc, scale), [TanhTransform(cache_size=1)])
    torch.testing.assert_close(log_prob, reference.log_prob(action).sum(-1), rtol=1e-6, atol=1e-6)


def test_log_probability_and_gradient_are_right_at_saturation() -> None:
    loc = torch.tensor([[40.0]], requires_grad=True)
    action, log_prob = squashed_gaussian(loc, torch.ones(1, 1), torch.zeros(1, 1))
    assert action.item() == 1.0
    # log N(u; u, 1) - log(1 - tanh(u)^2) with 1 - tanh(u)^2 -> 4 exp(-2u)
    assert log_prob.item() == pytest.approx(-0.5 * math.log(2 * math.pi) - math.log(4) + 80, rel=1e-5)
    log_prob.sum().backward()
    assert loc.grad.item() == pytest.approx(2.0)


def test_actor_is_linear_layernorm_and_three_layers_without_tanh() -> None:
    policy, features = actor(), torch.rand(4, 40)
    hidden = F.layer_norm(features @ policy.trunk.linear.weight.T, (10,))
    for layer in (policy.mlp.first, policy.mlp.middle):
        hidden = (hidden @ layer.weight.T).clamp_min(0)
    loc, raw = (hidden @ policy.mlp.last.weight.T).split(3, dim=-1)
    std = torch.exp(-10 + 6 * (torch.tanh(raw) + 1))
    torch.testing.assert_close(policy(features), (loc, std))
    torch.testing.assert_close(policy.mode(features), torch.tanh(loc))


def test_sample_uses_the_given_noise_and_zero_noise_is_the_mode() -> None:
    policy, features = actor(), torch.rand(4, 40)
    action, log_prob = policy.sample(features, noise=torch.zeros(4, 3))
    assert torch.equal(action, policy.mode(features))
    assert log_prob.shape == (4,)


def test_sample_draws_from_its_generator_and_not_from_the_global_one() -> None:
    policy, features = actor(), torch.rand(4, 40)
    before = torch.get_rng_state()
    first, _ = policy.sample(features, generator=torch.Generator().manual_seed(5))
    again, _ = policy.sample(features, generator=torch.Generator().manual_seed(5))
    other, _ = policy.sample(features, generator=torch.Generator().manual_seed(6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_sample_is_reparameterised() -> None:
    policy = actor()
    action, _ = policy.sample(torch.rand(4, 40))
    action.sum().backward()
    assert policy.trunk.linear.weight.grad.abs().sum() > 0


def test_log_std_bounds_are_respected_and_checked() -> None:
    raw = torch.tensor([-1e6, 0.0, 1e6])
    torch.testing.assert_close(squash_log_std(raw, (-10, 2)), torch.tensor([-10.0, -4.0, 2.0]))
    with pytest.raises(ValueError, match="low < high"):
        actor(log_std_bounds=(2, -10))


def test_both_heads_share_one_trunk() -> None:
    twin, features, action = critic(), torch.rand(4, 40), torch.rand(4, 3) * 2 - 1
    bottleneck = F.layer_norm(features @ twin.trunk.linear.weight.T, (10,))
    values = []
    for head in (twin.q1, twin.q2):
        hidden = torch.cat([bottleneck, action], dim=-1)
        hidden = (hidden @ head.first.weight.T).clamp_min(0)
        hidden = (hidden @ head.middle.weight.T).clamp_min(0)
        values.append(hidden @ head.last.weight.T)
    torch.testing.assert_close(twin(features, action), torch.cat(values, dim=-1))
    assert not torch.equal(values[0], values[1])
    assert sum("trunk.linear.weight" in name for name, _ in twin.named_parameters()) == 1


def test_full_size_critic_has_one_trunk_of_39200_by_50() -> None:
    twin = TwinCritic(39_200, 6)
    trunk = 39_200 * 50 + 50 + 100
    head = 57 * 1024 + 1025 * 1024 + 1025
    # The first layer has 50 + 6 inputs and a bias.
    assert sum(p.numel() for p in twin.parameters()) == trunk + 2 * head


@pytest.mark.parametrize("make", [actor, critic])
def test_linear_layers_are_orthogonal_with_zero_bias(make) -> None:
    for layer in make().modules():
        if isinstance(layer, torch.nn.Linear):
            weight = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
            torch.testing.assert_close(weight @ weight.T, torch.eye(len(weight)), rtol=0, atol=1e-5)
            assert not layer.bias.any()


def test_bfloat16_is_close_and_returns_float32() -> None:
    policy, twin = actor(), critic()
    features, action = torch.rand(64, 40), torch.rand(64, 3)
    loc, _ = policy(features)
    values = twin(features, action)
    set_compute_dtype(policy, torch.bfloat16)
    set_compute_dtype(twin, torch.bfloat16)
    low_loc, low_scale = policy(features.to(torch.bfloat16))
    low_values = twin(features.to(torch.bfloat16), action)
    assert low_loc.dtype == low_scale.dtype == low_values.dtype == torch.float32
    assert (low_loc - loc).norm() / loc.norm() < 0.03
    assert (low_values - values).norm() / values.norm() < 0.03


def test_leading_dimensions_are_kept_and_one_row_is_legal() -> None:
    assert critic()(torch.rand(2, 5, 40), torch.rand(2, 5, 3)).shape == (2, 5, 2)
    assert actor().sample(torch.rand(1, 40))[1].shape == (1,)
    assert actor().mode(torch.rand(40)).shape == (3,)


def test_config_rebuilds_the_networks() -> None:
    SquashedGaussianActor(**actor().config).load_state_dict(actor().state_dict())
    TwinCritic(**critic().config).load_state_dict(critic().state_dict())

"""Actors and critics: arithmetic of the released agents, saturation, noise."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from crptpro.modules import DeterministicActor, SquashedGaussianActor, TwinCritic
from crptpro.modules.actor_critic import squashed_gaussian


def actor(**options) -> SquashedGaussianActor:
    torch.manual_seed(0)
    return SquashedGaussianActor(40, 3, bottleneck_dim=10, hidden_dim=32, **options)


def critic(**options) -> TwinCritic:
    torch.manual_seed(0)
    return TwinCritic(40, 3, bottleneck_dim=10, hidden_dim=32, **options)


def test_golden_values_of_the_squashed_gaussian() -> None:
    one = actor().double()
    one.mlp.forward = lambda inputs: torch.tensor([[0.3, 0.2]], dtype=torch.float64)  # type: ignore[method-assign]
    loc, scale = one(torch.zeros(1, 40, dtype=torch.float64))
    action, log_prob = squashed_gaussian(loc, scale, torch.tensor([[0.5]], dtype=torch.float64))
    assert scale.log().item() == pytest.approx(-2.815748, abs=1e-6)
    assert action.item() == pytest.approx(0.318458, abs=1e-6)
    assert log_prob.item() == pytest.approx(1.878744, abs=1e-6)


def test_log_probability_and_gradient_are_right_at_saturation() -> None:
    loc = torch.tensor([[40.0]], requires_grad=True)
    action, log_prob = squashed_gaussian(loc, torch.ones(1, 1), torch.zeros(1, 1))
    assert action.item() == 1.0
    # log N(u; u, 1) - log(1 - tanh(u)^2) with 1 - tanh(u)^2 -> 4 exp(-2u)
    assert log_prob.item() == pytest.approx(-0.5 * math.log(2 * math.pi) - math.log(4) + 80, rel=1e-5)
    log_prob.sum().backward()
    assert loc.grad.item() == pytest.approx(2.0)


def perceptron(mlp: torch.nn.Module, inputs: torch.Tensor) -> torch.Tensor:
    for layer in (mlp.first, mlp.middle):
        inputs = (inputs @ layer.weight.T).clamp_min(0)
    return inputs @ mlp.last.weight.T


@pytest.mark.parametrize("has_tanh", [False, True])
def test_actor_and_critic_are_linear_layernorm_and_three_layers_and_both_heads_share_one_trunk(has_tanh: bool) -> None:
    features, action = torch.rand(4, 40), torch.rand(4, 3) * 2 - 1

    def bottleneck(network: torch.nn.Module) -> torch.Tensor:
        hidden = F.layer_norm(features @ network.trunk.linear.weight.T, (10,))
        return torch.tanh(hidden) if has_tanh else hidden

    policy, twin = actor(has_tanh=has_tanh), critic(has_tanh=has_tanh)
    loc, raw = perceptron(policy.mlp, bottleneck(policy)).split(3, dim=-1)
    torch.testing.assert_close(policy(features), (loc, torch.exp(-10 + 6 * (torch.tanh(raw) + 1))))
    torch.testing.assert_close(policy.mode(features), torch.tanh(loc))
    inputs = torch.cat([bottleneck(twin), action], dim=-1)
    values = [perceptron(head, inputs) for head in (twin.q1, twin.q2)]
    torch.testing.assert_close(twin(features, action), torch.cat(values, dim=-1))
    assert not torch.equal(*values)


def test_parameter_counts_are_the_published_ones() -> None:
    head = 57 * 1024 + 1025 * 1024 + 1025
    count = sum(p.numel() for p in TwinCritic(39_200, 6).parameters())
    assert count == 39_200 * 50 + 50 + 100 + 2 * head


def test_samples_come_from_the_generator_alone() -> None:
    policy, features, before = actor(), torch.rand(4, 40), torch.get_rng_state()
    first, again, other = (
        policy.sample(features, generator=torch.Generator().manual_seed(seed))[0] for seed in (5, 5, 6)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_leading_dimensions_are_kept_one_row_is_legal_and_bounds_are_in_order() -> None:
    with pytest.raises(ValueError, match="low < high"):
        actor(log_std_bounds=(2, -10))
    assert critic()(torch.rand(2, 5, 40), torch.rand(2, 5, 3)).shape == (2, 5, 2)
    assert actor().sample(torch.rand(1, 40))[1].shape == (1,)
    assert actor().mode(torch.rand(40)).shape == (3,)


def test_the_skill_policy_clips_its_noise_and_lets_the_gradient_through_the_bound() -> None:
    policy, inputs = DeterministicActor(40, 3, skill_dim=4), torch.rand(6, 44)
    mean = policy(inputs)
    assert mean.abs().max() <= 1

    def noise() -> dict:
        return {"generator": torch.Generator().manual_seed(1)}

    drawn = 0.2 * torch.randn(6, 3, **noise())
    torch.testing.assert_close(policy.sample(inputs, **noise()), mean + drawn)
    clipped = policy.sample(inputs, noise_clip=0.05, **noise())
    torch.testing.assert_close(clipped, mean + drawn.clamp(-0.05, 0.05))
    policy.noise_std = 1e3
    action = policy.sample(inputs, **noise())
    torch.testing.assert_close(action, drawn.sign() * (1 - 1e-6), rtol=0, atol=2e-6)
    action.sum().backward()
    assert policy.mlp.last.weight.grad.any()

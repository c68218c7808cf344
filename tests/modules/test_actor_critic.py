"""Actors and critics: arithmetic of the released agents, saturation, initialisation, TorchRL's exploration."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal

from crptpro.modules import DeterministicActor, SquashedGaussianActor, TwinCritic, set_compute_dtype
from crptpro.modules.actor_critic import squashed_gaussian


def actor(**options) -> SquashedGaussianActor:
    torch.manual_seed(0)
    return SquashedGaussianActor(40, 3, bottleneck_dim=10, hidden_dim=32, **options)


def critic(**options) -> TwinCritic:
    torch.manual_seed(0)
    return TwinCritic(40, 3, bottleneck_dim=10, hidden_dim=32, **options)


def skilled(**options) -> DeterministicActor:
    torch.manual_seed(0)
    return DeterministicActor(40, 3, skill_dim=4, bottleneck_dim=10, hidden_dim=32, **options)


def test_golden_values_of_the_squashed_gaussian() -> None:
    one = actor().double()
    one.mlp.forward = lambda inputs: torch.tensor([[0.3, 0.2]], dtype=torch.float64)  # type: ignore[method-assign]
    loc, scale = one(torch.zeros(1, 40, dtype=torch.float64))
    action, log_prob = squashed_gaussian(loc, scale, torch.tensor([[0.5]], dtype=torch.float64))
    assert scale.log().item() == pytest.approx(-2.815748, abs=1e-6)
    assert action.item() == pytest.approx(0.318458, abs=1e-6)
    assert log_prob.item() == pytest.approx(1.878744, abs=1e-6)


def test_log_probability_equals_torch_distributions_away_from_saturation() -> None:
    loc, scale, noise = torch.randn(3, 5, 3).double()
    scale = scale.abs() + 0.1
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


def test_samples_come_from_the_noise_or_the_generator_and_are_reparameterised() -> None:
    policy, features = actor(), torch.rand(4, 40)
    action, log_prob = policy.sample(features, noise=torch.zeros(4, 3))
    assert torch.equal(action, policy.mode(features))
    assert log_prob.shape == (4,)
    before = torch.get_rng_state()
    first, again, other = (
        policy.sample(features, generator=torch.Generator().manual_seed(seed))[0] for seed in (5, 5, 6)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)
    first.sum().backward()
    assert policy.trunk.linear.weight.grad.any()


@pytest.mark.parametrize("make", [actor, critic, skilled])
def test_linear_layers_are_orthogonal_with_zero_bias(make) -> None:
    for layer in make().modules():
        if isinstance(layer, torch.nn.Linear):
            weight = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
            torch.testing.assert_close(weight @ weight.T, torch.eye(len(weight)), rtol=0, atol=1e-5)
            assert not layer.bias.any()


def test_bfloat16_is_close_and_returns_float32() -> None:
    policy, twin = actor(), critic()
    features, action = torch.rand(64, 40), torch.rand(64, 3)
    expected = [policy(features)[0], twin(features, action)]
    for network in (policy, twin):
        set_compute_dtype(network, torch.bfloat16)
    found = [policy(features.bfloat16())[0], twin(features.bfloat16(), action)]
    for one, two in zip(found, expected):
        assert one.dtype == torch.float32
        assert (one - two).norm() / two.norm() < 0.03


def test_leading_dimensions_are_kept_and_one_row_is_legal() -> None:
    assert critic()(torch.rand(2, 5, 40), torch.rand(2, 5, 3)).shape == (2, 5, 2)
    assert actor().sample(torch.rand(1, 40))[1].shape == (1,)
    assert actor().mode(torch.rand(40)).shape == (3,)


@pytest.mark.parametrize(
    "make", [SquashedGaussianActor, TwinCritic, lambda *a, **k: DeterministicActor(*a, skill_dim=np.int8(4), **k)]
)
def test_sizes_of_any_number_type_become_plain_integers_in_the_card(make) -> None:
    module = make(np.int64(6), 2.0, hidden_dim=torch.tensor(8))
    assert json.loads(json.dumps(module.config)) == module.config
    type(module)(**module.config).load_state_dict(module.state_dict())
    with pytest.raises(ValueError, match="`action_dim` must be at least 1"):
        make(6, 0)
    with pytest.raises(ValueError, match="low < high"):
        actor(log_std_bounds=(2, -10))


def test_the_skill_policy_clips_its_noise_and_lets_the_gradient_through_the_bound() -> None:
    policy, inputs = skilled(), torch.rand(6, 44)
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


def test_probabilistic_actor_follows_the_exploration_type() -> None:
    network = actor()
    policy = ProbabilisticActor(
        TensorDictModule(network, ["features"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    td = TensorDict({"features": torch.randn(4, 40)}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(policy(td.copy())["action"], network.mode(td["features"]))
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(policy(td.copy())["action"], policy(td.copy())["action"])

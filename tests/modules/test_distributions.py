"""The action distribution as TorchRL's probabilistic modules use it."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from crptpro.modules import SquashedGaussianActor
from crptpro.modules.actor_critic import squashed_gaussian
from crptpro.modules.distributions import SquashedGaussian


def test_own_samples_are_scored_before_the_tanh() -> None:
    policy = SquashedGaussian(torch.full((1, 1), 40.0), torch.ones(1, 1))
    action = policy.rsample()
    assert action.item() == 1.0
    assert policy.log_prob(action).item() > 70
    assert policy.log_prob(action.clone()).item() < 0  # a stranger's action is inverted with a margin


def test_other_actions_are_inverted() -> None:
    policy = SquashedGaussian(torch.zeros(3, 2).double(), torch.ones(3, 2).double())
    action = policy.rsample()
    torch.testing.assert_close(policy.log_prob(action.clone()), policy.log_prob(action), rtol=1e-5, atol=1e-5)


def parameters(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    draws = torch.Generator().manual_seed(seed)
    loc, raw = torch.randn(2, 5, 3, generator=draws, dtype=torch.float64)
    return loc.requires_grad_(), raw.exp().requires_grad_()


def test_the_score_of_an_own_sample_equals_that_of_the_same_action_from_elsewhere() -> None:
    loc, scale = parameters()
    policy = SquashedGaussian(loc, scale)
    action = policy.sample()
    own = torch.autograd.grad(policy.log_prob(action).sum(), (loc, scale))
    given = torch.autograd.grad(policy.log_prob(action.clone()).sum(), (loc, scale))
    assert own[0].abs().min() > 0
    for ours, theirs in zip(own, given):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_the_gradient_of_a_reparameterised_sample_passes_through_it() -> None:
    loc, scale = parameters()
    policy = SquashedGaussian(loc, scale)
    torch.manual_seed(0)
    own = torch.autograd.grad(policy.log_prob(policy.rsample()).sum(), (loc, scale))
    torch.manual_seed(0)
    noise = torch.randn_like(loc)
    expected = torch.autograd.grad(squashed_gaussian(loc, scale, noise)[1].sum(), (loc, scale))
    for ours, theirs in zip(own, expected):
        torch.testing.assert_close(ours, theirs)


def test_sample_shape_comes_first_and_samples_differ() -> None:
    sample = SquashedGaussian(torch.zeros(3, 2), torch.ones(3, 2)).rsample((4,))
    assert sample.shape == (4, 3, 2)
    policy = SquashedGaussian(torch.zeros(3, 2), torch.ones(3, 2))
    assert policy.log_prob(policy.sample((4,))).shape == (4, 3)
    assert not torch.equal(sample[0], sample[1])


def test_probabilistic_actor_follows_the_exploration_type() -> None:
    actor = SquashedGaussianActor(6, 2, hidden_dim=8)
    policy = ProbabilisticActor(
        TensorDictModule(actor, ["features"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=SquashedGaussian,
    )
    td = TensorDict({"features": torch.randn(4, 6)}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(policy(td.copy())["action"], actor.mode(td["features"]))
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(policy(td.copy())["action"], policy(td.copy())["action"])

"""RAD-SAC, its average over two views, DrQ and skill-DDPG against the released updates, typed again."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from loss_cases import (
    ACTIONS,
    FEATURES,
    averaged_sac,
    disturb,
    drq,
    pixel_batch,
    rad_sac,
    skill_batch,
    skill_ddpg,
    small_encoder,
    target_state,
    total,
    transition_batch,
    two_view_batch,
)
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss

from crptpro.modules import DeterministicActor, SquashedGaussianActor, TwinCritic
from crptpro.objectives import DrQLoss, RADSACLoss, SkillDDPGLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise_of(count: int, draws: int) -> list[Tensor]:
    source = generator()
    return [torch.randn(count, ACTIONS, generator=source) for _ in range(draws)]


def target_of(loss):
    target = copy.deepcopy(loss.critic)
    target.load_state_dict(target_state(loss, "qvalue_network"))
    return target


def smaller(values: Tensor) -> Tensor:
    return values.min(-1, keepdim=True).values


def require_same(
    out: TensorDict, expected: dict[str, Tensor], *twins: tuple[nn.Module, nn.Module], **tolerance
) -> None:
    """Require the released values, and after the backward pass the gradients of our networks' released twins."""
    for key, value in expected.items():
        torch.testing.assert_close(out[key], value, msg=key, **tolerance)
    total(out).backward()
    for ours, theirs in twins:
        for parameter, twin in zip(ours.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(parameter.grad, twin.grad, rtol=1e-3, atol=1e-6)


def released_policy(actor: SquashedGaussianActor, features: Tensor, noise: Tensor):
    mu, log_std = actor.mlp(actor.trunk(features)).chunk(2, dim=-1)
    std = (-10 + 0.5 * 12 * (torch.tanh(log_std) + 1)).exp()
    u = mu + std * noise
    log_prob = torch.distributions.Normal(mu, std).log_prob(u) - 2 * (math.log(2) - u - F.softplus(-2 * u))
    return torch.tanh(u), log_prob.sum(-1, keepdim=True)


@pytest.mark.parametrize(
    ("make", "batch", "views"),
    [
        (rad_sac, transition_batch, ["features"]),
        (averaged_sac, two_view_batch, ["features", "features_view"]),
        (drq, pixel_batch, ["pixels", "pixels_view"]),
    ],
)
def test_sac_equals_the_released_updates_in_value_and_gradients(make, batch, views: list[str]) -> None:
    """``proto.py`` of CRPTpro and Proto-RL; ``drq.py`` with its two views and, in DrQ, the encoder inside."""
    td, loss = batch(), make(generator=generator())
    disturb(loss.critic)
    actor, critic, target = copy.deepcopy(loss.actor), copy.deepcopy(loss.critic), target_of(loss)
    log_alpha = torch.tensor(math.log(0.1), requires_grad=True)
    *next_noises, noise = noise_of(6, len(views) + 1)

    def encode(images: Tensor) -> Tensor:
        return critic.encoder(images).detach() if make is drq else images

    with torch.no_grad():
        ys = []
        for view, next_noise in zip(views, next_noises, strict=True):
            action, log_prob = released_policy(actor, encode(td["next", view]), next_noise)
            v = smaller(target(td["next", view], action)) - 0.1 * log_prob
            ys.append(td["next", "reward"] + 0.99 * (~td["next", "terminated"]) * v)
        y = sum(ys) / len(ys)
    qs = [critic(td[view], td["action"]).split(1, dim=-1) for view in views]
    critic_loss = sum(F.mse_loss(q1, y) + F.mse_loss(q2, y) for q1, q2 in qs)
    critic_loss.backward()
    h = encode(td[views[0]])
    action, log_prob = released_policy(actor, h, noise)
    head = copy.deepcopy(critic.head if make is drq else critic)
    actor_loss = (log_alpha.exp().detach() * log_prob - smaller(head(h, action))).mean()
    actor_loss.backward()
    alpha_loss = (log_alpha.exp() * (-log_prob - (-ACTIONS)).detach()).mean()
    alpha_loss.backward()

    out = loss(td)
    td_error = sum(torch.maximum((q1 - y).abs(), (q2 - y).abs()).mean() for q1, q2 in qs) / len(qs)
    q_mean = torch.stack([torch.cat(q) for q in qs]).mean()
    expected = {"loss_qvalue": critic_loss, "loss_actor": actor_loss, "loss_alpha": alpha_loss}
    expected |= {"alpha": torch.tensor(0.1), "entropy": -log_prob.mean(), "target_q_mean": y.mean(), "q_mean": q_mean}
    twins = (loss.critic, critic), (loss.actor, actor)
    require_same(out, expected | {"td_error": td_error}, *twins, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(loss.log_alpha.grad, log_alpha.grad)


def test_separate_steps_use_the_critic_just_stepped() -> None:
    td, loss = transition_batch(), rad_sac()
    optimizer = torch.optim.SGD(loss.critic.parameters(), lr=0.5)
    torch.manual_seed(0)
    before = loss.actor_and_temperature_loss(td)["loss_actor"].item()
    loss.critic_loss(td)["loss_qvalue"].backward()
    optimizer.step()
    torch.manual_seed(0)
    stepped = loss.actor_and_temperature_loss(td)
    assert stepped["loss_actor"].item() != before
    assert set(stepped.keys()) == {"loss_actor", "loss_alpha", "alpha", "entropy"}
    assert set(loss.critic_loss(td).keys()) == {"loss_qvalue", "q_mean", "target_q_mean", "td_error"}


@pytest.mark.parametrize(("make", "batch"), [(rad_sac, transition_batch), (drq, pixel_batch)])
def test_the_losses_have_the_names_and_results_of_torchrl(make, batch) -> None:
    td = batch()
    expected = make(generator=generator())(td)
    loss = make(generator=generator())
    loss_qvalue, diagnostics = loss.qvalue_v2_loss(td)
    loss_actor, drawn = loss.actor_loss(td)
    loss_alpha = loss.alpha_loss(drawn["log_prob"])
    assert drawn["log_prob"].shape == loss_alpha.shape == td.shape
    found = {"loss_qvalue": loss_qvalue, "loss_actor": loss_actor, "loss_alpha": loss_alpha.mean(), **diagnostics}
    for name, value in found.items():
        torch.testing.assert_close(value, expected[name], msg=name)
    assert {*found, "alpha", "entropy"} == set(expected.keys())


def test_networks_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(TypeError, match=r"takes an actor such as .* got a TwinCritic as the actor"):
        RADSACLoss(TwinCritic(FEATURES, 2), SquashedGaussianActor(FEATURES, 2))


def test_target_entropy_and_discount_are_options_and_the_discount_is_raised_to_the_n_of_n_step_transitions() -> None:
    td = transition_batch()
    assert rad_sac(target_entropy=-100.0).target_entropy == -100
    reward = td["next", "reward"].mean()

    def target(steps_ahead: int | None = None, **options: Any) -> Tensor:
        loss, batch = rad_sac(generator=generator(), **options), td.copy()
        if steps_ahead is not None:
            batch["steps_to_next_obs"] = torch.full((len(td), 1), steps_ahead)
        return loss.critic_loss(batch)["target_q_mean"]

    torch.testing.assert_close(target(gamma=0.0), reward)
    value = (target() - reward) / 0.99
    for steps_ahead in (1, 2, 3):
        torch.testing.assert_close(target(steps_ahead), reward + 0.99**steps_ahead * value)


@pytest.mark.parametrize(("make", "batch"), [(rad_sac, transition_batch), (skill_ddpg, skill_batch)])
def test_features_never_receive_a_gradient(make, batch) -> None:
    td = batch()
    td["features"].requires_grad_()
    td["next", "features"].requires_grad_()
    out = make()(td)
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    assert td["features"].grad is None
    assert td["next", "features"].grad is None


def test_given_networks_are_trained_in_place_with_their_initialisation_by_a_torchrl_loss() -> None:
    actor, critic = SquashedGaussianActor(FEATURES, ACTIONS), TwinCritic(FEATURES, ACTIONS)
    before = copy.deepcopy(critic.state_dict())
    loss = RADSACLoss(actor, critic)
    assert isinstance(loss, SACLoss)
    assert (loss.actor, loss.critic) == (actor, critic)
    assert all(torch.equal(value, before[key]) for key, value in critic.state_dict().items())
    own = {id(p) for p in loss.parameters()}
    assert {id(p) for p in [*actor.parameters(), *critic.parameters()]} | {id(loss.log_alpha)} == own
    td = transition_batch()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(loss.actor_network(td.copy())["action"], actor.mode(td["features"]))
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(loss.actor_network(td)["action"], actor.mode(td["features"]))


def truncated_normal(mu: Tensor, noise: Tensor) -> Tensor:
    """utils.TruncatedNormal of the released code, with the noise given."""
    x = mu + torch.clamp(noise * 0.2, -0.3, 0.3)
    clamped = torch.clamp(x, -1.0 + 1e-6, 1.0 - 1e-6)
    return x - x.detach() + clamped.detach()


def test_skill_ddpg_equals_the_released_update_in_value_and_gradients() -> None:
    loss, td = skill_ddpg(generator=generator()), skill_batch()
    td["steps_to_next_obs"] = torch.full((len(td), 1), 3)
    disturb(loss.critic)
    actor, critic, target = copy.deepcopy(loss.actor), copy.deepcopy(loss.critic), target_of(loss)
    next_noise, noise = noise_of(6, 2)
    observation = torch.cat([td["features"], td["skill"]], 1)
    following = torch.cat([td["next", "features"], td["skill"]], 1)

    with torch.no_grad():
        action = truncated_normal(torch.tanh(actor.mlp(actor.trunk(following))), next_noise)
        y = td["next", "reward"] + 0.99**3 * ~td["next", "terminated"] * smaller(target(following, action))
    q1, q2 = critic(observation, td["action"]).split(1, dim=-1)
    critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
    critic_loss.backward()
    action = truncated_normal(torch.tanh(actor.mlp(actor.trunk(observation))), noise)
    actor_loss = -smaller(copy.deepcopy(critic)(observation, action)).mean()
    actor_loss.backward()

    out = loss(td)
    expected = {"loss_qvalue": critic_loss, "loss_actor": actor_loss, "target_q_mean": y.mean()}
    expected |= {"q_mean": torch.cat([q1, q2]).mean()}
    expected |= {"td_error": torch.maximum((q1 - y).abs(), (q2 - y).abs()).mean()}
    require_same(out, expected, (loss.critic, critic), (loss.actor, actor))
    td["next", "terminated"].fill_(True)
    assert loss(td)["target_q_mean"] == td["next", "reward"].mean()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rad_sac(alpha_init=0.0), "`alpha_init` must be positive, got 0.0"),
        (lambda: rad_sac(target_entropy="auto"), "`target_entropy`"),
        (
            lambda: RADSACLoss(SquashedGaussianActor(FEATURES, 3), TwinCritic(FEATURES, 2)),
            "The actor was built with action_dim=3, the critic with 2",
        ),
        (
            lambda: DrQLoss(small_encoder(), SquashedGaussianActor(1, 2), TwinCritic(small_encoder().feature_dim, 2)),
            "The actor was built with feature_dim=1",
        ),
        (lambda: rad_sac(gamma=1.01), "`gamma` must be at most 1, got 1.01"),
        (
            lambda: DrQLoss(drq().encoder, drq().actor, TwinCritic(7, ACTIONS)),
            r"7 features, the encoder gives \d+; build it with feature_dim=",
        ),
        (
            lambda: SkillDDPGLoss(DeterministicActor(FEATURES, ACTIONS, skill_dim=3), TwinCritic(FEATURES, ACTIONS)),
            "built for 12 inputs, the actor sees 15",
        ),
        (lambda: skill_ddpg(noise_clip=-0.1), r"`noise_clip` must be at least 0, got -0\.1"),
    ],
)
def test_networks_that_do_not_fit_and_numbers_that_cannot_be_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()

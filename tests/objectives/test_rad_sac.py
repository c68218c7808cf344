"""RADSACLoss against the released agent's update, typed again with plain torch."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from loss_cases import ACTIONS, FEATURES, rad_sac, transition_batch
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from crptpro.modules import SquashedGaussianActor, TwinCritic, set_compute_dtype
from crptpro.objectives import RADSACLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def released_policy(actor: SquashedGaussianActor, features: torch.Tensor, noise: torch.Tensor):
    hidden = actor.trunk(features)
    mu, log_std = actor.mlp(hidden).chunk(2, dim=-1)
    std = (-10 + 0.5 * 12 * (torch.tanh(log_std) + 1)).exp()
    u = mu + std * noise
    log_prob = torch.distributions.Normal(mu, std).log_prob(u) - 2 * (math.log(2) - u - F.softplus(-2 * u))
    return torch.tanh(u), log_prob.sum(-1, keepdim=True)


def noise_of(count: int, draws: int) -> list[torch.Tensor]:
    source = generator()
    return [torch.randn(count, ACTIONS, generator=source) for _ in range(draws)]


def test_all_losses_and_gradients_equal_the_released_update() -> None:
    td, loss = transition_batch(), rad_sac(generator=generator())
    with torch.no_grad():
        for parameter in loss.critic.parameters():  # the target differs from its source
            parameter.add_(0.1 * torch.randn_like(parameter))
    target = TwinCritic(**loss.critic.config)
    target.load_state_dict(
        {".".join(key[1:]): value.data for key, value in loss.target_qvalue_network_params.items(True, True)}
    )
    actor, critic, log_alpha = (
        copy.deepcopy(loss.actor),
        copy.deepcopy(loss.critic),
        torch.tensor(math.log(0.1), requires_grad=True),
    )
    next_noise, noise = noise_of(6, 2)
    h, h_next, reward = td["features"], td["next", "features"], td["next", "reward"]

    with torch.no_grad():
        next_action, log_prob = released_policy(actor, h_next, next_noise)
        target_v = target(h_next, next_action).min(-1, keepdim=True).values - 0.1 * log_prob
        y = reward + 0.99 * (~td["next", "terminated"]) * target_v
    q1, q2 = critic(h, td["action"]).split(1, dim=-1)
    critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
    critic_loss.backward()
    critic_gradients = [p.grad.clone() for p in critic.parameters()]
    action, log_prob = released_policy(actor, h, noise)
    actor_loss = (log_alpha.exp().detach() * log_prob - critic(h, action).min(-1, keepdim=True).values).mean()
    actor_loss.backward()
    alpha_loss = (log_alpha.exp() * (-log_prob - (-ACTIONS)).detach()).mean()
    alpha_loss.backward()

    out = loss(td)
    torch.testing.assert_close(out["loss_qvalue"], critic_loss)
    torch.testing.assert_close(out["loss_actor"], actor_loss)
    torch.testing.assert_close(out["loss_alpha"], alpha_loss)
    torch.testing.assert_close(out["entropy"], -log_prob.mean())
    torch.testing.assert_close(out["target_q_mean"], y.mean())
    torch.testing.assert_close(out["q_mean"], torch.cat([q1, q2]).mean())
    torch.testing.assert_close(out["td_error"], torch.maximum((q1 - y).abs(), (q2 - y).abs()).mean())
    (out["loss_qvalue"] + out["loss_actor"] + out["loss_alpha"]).backward()
    for parameter, expected in zip(loss.critic.parameters(), critic_gradients, strict=True):
        torch.testing.assert_close(parameter.grad, expected)
    for parameter, twin in zip(loss.actor.parameters(), actor.parameters(), strict=True):
        torch.testing.assert_close(parameter.grad, twin.grad)
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
    stepped["loss_actor"].backward()
    optimizer.zero_grad()
    assert all(p.grad is None for p in loss.critic.parameters())
    assert set(stepped.keys()) == {"loss_actor", "loss_alpha", "alpha", "entropy"}
    assert set(loss.critic_loss(td).keys()) == {"loss_qvalue", "q_mean", "target_q_mean", "td_error"}


def test_only_termination_cuts_the_bootstrap() -> None:
    td = transition_batch()
    td["next", "reward"].fill_(1.0)
    terminated = td["next", "terminated"].squeeze(-1)
    target = rad_sac(generator=generator())._compute_target_v2(td)
    assert torch.equal(target == 1.0, terminated)
    td["next", "done"].fill_(True)  # truncation changes nothing
    torch.testing.assert_close(rad_sac(generator=generator())._compute_target_v2(td), target)


def test_discount_is_an_option_and_stays_changeable() -> None:
    td = transition_batch()
    reward = td["next", "reward"].squeeze(-1)
    torch.testing.assert_close(rad_sac(gamma=0.0)._compute_target_v2(td), reward)
    loss = rad_sac()
    assert loss.value_estimator.gamma.item() == pytest.approx(0.99)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.0)
    torch.testing.assert_close(loss._compute_target_v2(td), reward)


def test_features_never_receive_a_gradient() -> None:
    td = transition_batch()
    td["features"].requires_grad_()
    td["next", "features"].requires_grad_()
    out = rad_sac()(td)
    (out["loss_qvalue"] + out["loss_actor"] + out["loss_alpha"]).backward()
    assert td["features"].grad is None
    assert td["next", "features"].grad is None


def test_temperature_starts_at_a_tenth_and_falls_while_entropy_is_high() -> None:
    loss, td = rad_sac(), transition_batch()
    out = loss(td)
    assert out["alpha"].item() == pytest.approx(0.1)
    low_target = rad_sac(target_entropy=-100.0)
    low_target(td)["loss_alpha"].backward()
    assert low_target.log_alpha.grad > 0  # descending lowers log_alpha
    assert loss.target_entropy.item() == -ACTIONS


def test_given_networks_are_trained_in_place_with_their_initialisation() -> None:
    actor, critic = SquashedGaussianActor(FEATURES, ACTIONS), TwinCritic(FEATURES, ACTIONS)
    before = copy.deepcopy(critic.state_dict())
    loss = RADSACLoss(actor, critic)
    assert loss.actor is actor
    assert loss.critic is critic
    assert all(torch.equal(value, before[key]) for key, value in critic.state_dict().items())
    own = {id(p) for p in loss.parameters()}
    assert {id(p) for p in [*actor.parameters(), *critic.parameters()]} | {id(loss.log_alpha)} == own


def test_generator_decides_the_noise_and_leaves_the_global_one_alone() -> None:
    td, state = transition_batch(), torch.get_rng_state()
    loss = rad_sac(generator=generator(1))
    state = torch.get_rng_state()
    first = loss(td)["loss_actor"]
    assert torch.equal(torch.get_rng_state(), state)
    loss.generator.manual_seed(1)
    assert torch.equal(loss(td)["loss_actor"], first)
    assert not torch.equal(loss(td)["loss_actor"], first)


def test_n_step_transitions_are_discounted_by_gamma_to_the_n() -> None:
    td, loss = transition_batch(), rad_sac(generator=generator())
    rows = torch.arange(len(td)) % 3 + 1
    td["steps_to_next_obs"] = rows.unsqueeze(-1)
    found = loss._compute_target_v2(td)
    one_step = rad_sac(generator=generator())
    one_step.load_state_dict(loss.state_dict())
    reward = td["next", "reward"].squeeze(-1)
    value = (one_step._compute_target_v2(td.exclude("steps_to_next_obs")) - reward) / 0.99
    torch.testing.assert_close(found, reward + 0.99**rows * value)


def test_target_follows_the_whole_critic_trunk_included() -> None:
    loss = rad_sac()
    updater = SoftUpdate(loss, tau=0.01)
    with torch.no_grad():
        for parameter in loss.critic.parameters():
            parameter.add_(1.0)
    source = loss.qvalue_network_params["module", "trunk", "linear", "weight"]
    target = loss.target_qvalue_network_params["module", "trunk", "linear", "weight"]
    torch.testing.assert_close(source - target, torch.ones_like(source))
    updater.step()
    torch.testing.assert_close(source - target, torch.full_like(source, 0.99))


def test_it_is_a_torchrl_sac_loss_whose_actor_acts() -> None:
    loss, td = rad_sac(), transition_batch()
    assert isinstance(loss, SACLoss)
    acted = loss.actor_network(td.copy())
    assert acted["action"].shape == (6, ACTIONS)
    assert acted["action"].abs().max() <= 1


def test_priority_weights_scale_rows() -> None:
    td = transition_batch()
    weighted = td.copy()
    weights = torch.zeros(6)
    weights[3] = 1.0
    weighted["priority_weight"] = weights
    rows = rad_sac(reduction="none", generator=generator())(td)["loss_qvalue"]
    loss = rad_sac(reduction="sum", generator=generator())(weighted)["loss_qvalue"]
    torch.testing.assert_close(loss, rows[3])


def test_diagnostics_are_means_over_the_rows_that_count() -> None:
    td, loss, kept = transition_batch(), rad_sac(generator=generator()), [0, 1, 4]
    _, rows = loss.qvalue_v2_loss(td)
    _, actions = loss.actor_loss(td)
    mask = torch.zeros(6, 1, dtype=torch.bool)
    mask[kept] = True
    td["mask"] = mask
    loss.loss_mask_key = "mask"
    loss.generator.manual_seed(0)
    out = loss(td)
    expected = {"q_mean": rows["q"], "target_q_mean": rows["target_q"], "td_error": rows["td_error"]}
    for key, value in {**expected, "entropy": -actions["log_prob"]}.items():
        torch.testing.assert_close(out[key], value[kept].mean(), msg=key)


@pytest.mark.parametrize(
    ("option", "value"), [("alpha_init", 0.0), ("alpha_init", -0.1), ("gamma", 1.01), ("gamma", -0.5)]
)
def test_a_temperature_or_discount_that_cannot_be_is_refused(option: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{option} must be .*got {value}"):
        rad_sac(**{option: value})


def test_bfloat16_losses_and_features_are_close_to_float32() -> None:
    td = transition_batch(64)
    expected = rad_sac(generator=generator())(td)
    low = set_compute_dtype(rad_sac(generator=generator()), torch.bfloat16)
    half = td.copy()
    half["features"] = td["features"].to(torch.bfloat16)
    half["next", "features"] = td["next", "features"].to(torch.bfloat16)
    out = low(half)
    assert all(value.dtype == torch.float32 for value in out.values())
    for key in ("loss_qvalue", "loss_actor"):
        assert out[key].item() == pytest.approx(expected[key].item(), rel=0.05, abs=0.02)


def test_observation_key_can_be_given_at_construction() -> None:
    td = transition_batch()
    expected = rad_sac(generator=generator())(td)["loss_qvalue"]
    td.rename_key_("features", "latent").rename_key_(("next", "features"), ("next", "latent"))
    assert torch.equal(rad_sac(generator=generator(), observation="latent")(td)["loss_qvalue"], expected)

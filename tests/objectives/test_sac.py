"""RAD-SAC, its average over two views, DrQ and skill-DDPG against the released updates, typed again."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from loss_cases import (
    ACTIONS,
    FEATURES,
    averaged_sac,
    drq,
    pixel_batch,
    rad_sac,
    skill_batch,
    skill_ddpg,
    target_state,
    transition_batch,
    two_view_batch,
)
from torch import Tensor, nn
from torchrl.objectives import SACLoss, ValueEstimators

from crptpro.modules import (
    DeterministicActor,
    PixelEncoder,
    SquashedGaussianActor,
    TwinCritic,
    set_compute_dtype,
)
from crptpro.modules.actor_critic import PixelCritic
from crptpro.objectives import DrQLoss, RADSACLoss, SkillDDPGLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
VIEWS = ("pixels", "pixels_view")
STD, CLIP = 0.2, 0.3


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise_of(count: int, draws: int) -> list[Tensor]:
    source = generator()
    return [torch.randn(count, ACTIONS, generator=source) for _ in range(draws)]


def disturb(critic: nn.Module) -> None:
    """The target differs from its source."""
    with torch.no_grad():
        for parameter in critic.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))


def layers_of(mlp: nn.Module) -> nn.Module:
    first, middle, last = (copy.deepcopy(layer) for layer in (mlp.first, mlp.middle, mlp.last))
    return nn.Sequential(first, nn.ReLU(), middle, nn.ReLU(), last)


def head_of(trunk: nn.Module) -> nn.Module:
    """Linear, LayerNorm, tanh."""
    return nn.Sequential(copy.deepcopy(trunk.linear), copy.deepcopy(trunk.norm), nn.Tanh())


# RAD-SAC -------------------------------------------------------------------------------------------------


def released_policy(actor: SquashedGaussianActor, features: torch.Tensor, noise: torch.Tensor):
    hidden = actor.trunk(features)
    mu, log_std = actor.mlp(hidden).chunk(2, dim=-1)
    std = (-10 + 0.5 * 12 * (torch.tanh(log_std) + 1)).exp()
    u = mu + std * noise
    log_prob = torch.distributions.Normal(mu, std).log_prob(u) - 2 * (math.log(2) - u - F.softplus(-2 * u))
    return torch.tanh(u), log_prob.sum(-1, keepdim=True)


def test_rad_sac_equals_the_released_update_in_value_and_gradients() -> None:
    td, loss = transition_batch(), rad_sac(generator=generator())
    disturb(loss.critic)
    target = TwinCritic(**loss.critic.config)
    target.load_state_dict(target_state(loss, "qvalue_network"))
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


def test_it_is_a_torchrl_sac_loss_whose_actor_acts() -> None:
    loss, td = rad_sac(), transition_batch()
    assert isinstance(loss, SACLoss)
    acted = loss.actor_network(td.copy())
    assert acted["action"].shape == (6, ACTIONS)
    assert acted["action"].abs().max() <= 1


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"alpha_init": 0.0}, "`alpha_init` must be positive, got 0.0"),
        ({"gamma": 1.01}, "`gamma` must be at most 1, got 1.01"),
        ({"gamma": -0.5}, "`gamma` must be at least 0"),
    ],
)
def test_a_temperature_or_discount_that_cannot_be_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rad_sac(**options)


# DrQ -----------------------------------------------------------------------------------------------------


class Convolutions(nn.Module):
    """The convolutions of drq.py: pixels over 255, ReLU after each, flattened."""

    def __init__(self, encoder: PixelEncoder) -> None:
        super().__init__()
        self.convs = copy.deepcopy(encoder.convs)

    def forward(self, pixels: Tensor) -> Tensor:
        hidden = pixels / 255.0
        for conv in self.convs:
            hidden = torch.relu(conv(hidden))
        return hidden.flatten(1)


class Critic(nn.Module):
    def __init__(self, critic: PixelCritic) -> None:
        super().__init__()
        self.convs, self.head = Convolutions(critic.encoder), head_of(critic.head.trunk)
        self.q1, self.q2 = layers_of(critic.head.q1), layers_of(critic.head.q2)

    def forward(self, pixels: Tensor, action: Tensor, *, detach: bool = False) -> tuple[Tensor, Tensor]:
        features = self.convs(pixels)
        hidden = torch.cat([self.head(features.detach() if detach else features), action], -1)
        return self.q1(hidden), self.q2(hidden)


class Actor(nn.Module):
    def __init__(self, loss: DrQLoss, convs: Convolutions) -> None:
        super().__init__()
        self.convs = convs  # tied: the very module of the critic
        self.head, self.mlp = head_of(loss.actor.trunk), layers_of(loss.actor.mlp)

    def forward(self, pixels: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        mu, raw = self.mlp(self.head(self.convs(pixels).detach())).chunk(2, -1)
        std = (-10 + 0.5 * 12 * (torch.tanh(raw) + 1)).exp()
        u = mu + std * noise
        density = torch.distributions.Normal(mu, std).log_prob(u)
        log_prob = (density - 2 * (math.log(2) - u - F.softplus(-2 * u))).sum(-1, keepdim=True)
        return torch.tanh(u), log_prob


class Retyped:
    """drq.py's networks with the weights of a loss, and its target with other ones."""

    def __init__(self, loss: DrQLoss) -> None:
        self.critic = Critic(loss.critic)
        self.actor = Actor(loss, self.critic.convs)
        fresh = PixelCritic(PixelEncoder(**loss.encoder.config), TwinCritic(**loss.critic.head.config))
        fresh.load_state_dict(target_state(loss, "qvalue_network"))
        self.target = Critic(fresh)
        self.log_alpha = torch.tensor(math.log(0.1), requires_grad=True)

    def losses(self, td: dict, noises: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            ys = []
            for view, noise in zip(VIEWS, noises):
                action, log_prob = self.actor(td["next", view], noise)
                v = torch.min(*self.target(td["next", view], action)) - alpha * log_prob
                ys.append(td["next", "reward"] + 0.99 * (~td["next", "terminated"]) * v)
            y = (ys[0] + ys[1]) / 2
        critic_loss = torch.zeros(())
        for view in VIEWS:
            q1, q2 = self.critic(td[view], td["action"])
            critic_loss = critic_loss + F.mse_loss(q1, y) + F.mse_loss(q2, y)
        action, log_prob = self.actor(td["pixels"], noises[2])
        q = torch.min(*self.critic(td["pixels"], action, detach=True))
        actor_loss = (alpha * log_prob - q).mean()
        alpha_loss = (self.log_alpha.exp() * (-log_prob + ACTIONS).detach()).mean()
        return critic_loss, actor_loss, alpha_loss


def test_drq_equals_the_released_update_in_value_and_gradients() -> None:
    loss, td = drq(generator=generator()), pixel_batch()
    disturb(loss.critic)
    twin = Retyped(loss)
    critic_loss, actor_loss, alpha_loss = twin.losses(td, noise_of(6, 3))
    out = loss(td)
    for key, expected in zip(
        ("loss_qvalue", "loss_actor", "loss_alpha"), (critic_loss, actor_loss, alpha_loss)
    ):
        torch.testing.assert_close(out[key], expected, rtol=1e-4, atol=1e-6)
    out["loss_qvalue"].backward()
    critic_loss.backward()
    heads = [p for part in (twin.critic.head, twin.critic.q1, twin.critic.q2) for p in part.parameters()]
    pairs = [*zip(loss.encoder.parameters(), twin.critic.convs.parameters(), strict=True)]
    pairs += [*zip(loss.critic.head.parameters(), heads, strict=True)]
    for ours, theirs in pairs:
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-3, atol=1e-6)
    loss.zero_grad()
    twin.critic.zero_grad()
    out["loss_actor"].backward()
    actor_loss.backward()
    assert all(p.grad is None for p in [*loss.critic.parameters(), *twin.critic.convs.parameters()])
    actor = [*twin.actor.head.parameters(), *twin.actor.mlp.parameters()]
    for ours, theirs in zip(loss.actor.parameters(), actor, strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-3, atol=1e-6)


def test_the_actor_reads_the_critics_convolutions_and_owns_none() -> None:
    loss, td = drq(), pixel_batch()
    assert not any("conv" in name for name, _ in loss.actor.named_parameters())
    before = loss(td)["loss_actor"].item()
    optimizer = torch.optim.SGD(loss.encoder.parameters(), lr=1.0)
    torch.manual_seed(0)
    loss.critic_loss(td)["loss_qvalue"].backward()
    assert all(p.grad.any() for p in loss.encoder.parameters())
    optimizer.step()  # nothing but the convolutions moves
    assert loss(td)["loss_actor"].item() != before


def test_the_targets_policy_sees_the_live_convolutions_and_its_values_the_target_copy() -> None:
    td = pixel_batch()
    loss = drq(generator=generator())
    unchanged = loss._compute_target_v2(td)
    for where in ("qvalue_network_params", "target_qvalue_network_params"):
        loss = drq(generator=generator())
        with torch.no_grad():
            getattr(loss, where).get(("module", "encoder", "convs", "0", "weight")).data.mul_(3.0)
        assert not torch.allclose(loss._compute_target_v2(td), unchanged), where
    # Only through the policy: where it acts without looking, the live convolutions do not matter.
    blind = drq(generator=generator())
    with torch.no_grad():
        for parameter in blind.actor.parameters():
            parameter.zero_()
        reference = blind._compute_target_v2(td)
        blind.encoder.convs[0].weight.mul_(3.0)
    blind.generator = generator()
    assert torch.equal(blind._compute_target_v2(td), reference)


def test_equal_views_give_twice_the_critic_loss_of_one() -> None:
    td = two_view_batch()
    for key in ("features", ("next", "features")):
        view = "features_view" if key == "features" else ("next", "features_view")
        td[view] = td[key].clone()
    loss = averaged_sac()
    with torch.no_grad():  # a policy without spread: both views act alike, up to what is negligible
        loss.actor.mlp.last.bias[ACTIONS:] = -30.0
        loss.log_alpha.fill_(-30.0)
    single = RADSACLoss(copy.deepcopy(loss.actor), copy.deepcopy(loss.critic), alpha_init=math.exp(-30.0))
    torch.testing.assert_close(
        loss.critic_loss(td)["loss_qvalue"], 2 * single.critic_loss(td)["loss_qvalue"], rtol=1e-3, atol=1e-5
    )


def test_each_next_view_has_an_action_of_its_own_and_the_target_is_their_mean() -> None:
    td = two_view_batch()
    loss = averaged_sac(generator=generator())
    both = loss._compute_target_v2(td)
    singles = []
    first, second = noise_of(6, 2)
    for key, noise in (("features", first), ("features_view", second)):
        features = td["next", key]
        with torch.no_grad():
            action, log_prob = loss.actor.sample(features, noise=noise)
            value = loss.critic(features, action).amin(-1) - 0.1 * log_prob
        alive = ~td["next", "terminated"].squeeze(-1)
        singles.append(td["next", "reward"].squeeze(-1) + 0.99 * alive * value)
    torch.testing.assert_close(both, (singles[0] + singles[1]) / 2)


def test_the_actor_learns_from_the_first_view_only() -> None:
    td, loss = two_view_batch(), averaged_sac()
    torch.manual_seed(0)
    expected = loss.actor_and_temperature_loss(td)["loss_actor"]
    td["features_view"] = td["features_view"] + 1
    torch.manual_seed(0)
    assert torch.equal(loss.actor_and_temperature_loss(td)["loss_actor"], expected)


def test_a_critic_for_another_encoder_is_refused_with_both_lengths() -> None:
    loss = drq()
    with pytest.raises(ValueError, match=r"7 features, the encoder gives \d+"):
        DrQLoss(loss.encoder, loss.actor, TwinCritic(7, ACTIONS))


# DDPG with skills ----------------------------------------------------------------------------------------


def critic_of(critic: TwinCritic):
    trunk, q1, q2 = head_of(critic.trunk), layers_of(critic.q1), layers_of(critic.q2)

    def values(observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        hidden = torch.cat([trunk(observation), action], -1)
        return q1(hidden), q2(hidden)

    return values, [*trunk.parameters(), *q1.parameters(), *q2.parameters()]


def truncated_normal(mu: Tensor, noise: Tensor) -> Tensor:
    """utils.TruncatedNormal of the released code, with the noise given."""
    eps = torch.clamp(noise * STD, -CLIP, CLIP)
    x = mu + eps
    clamped = torch.clamp(x, -1.0 + 1e-6, 1.0 - 1e-6)
    return x - x.detach() + clamped.detach()


def test_skill_ddpg_equals_the_released_update_in_value_and_gradients() -> None:
    loss, td = skill_ddpg(generator=generator()), skill_batch()
    disturb(loss.critic)
    plain = TwinCritic(**loss.critic.config)
    plain.load_state_dict(target_state(loss, "qvalue_network"))
    target, _ = critic_of(plain)
    critic, critic_parameters = critic_of(loss.critic)
    actor = nn.Sequential(head_of(loss.actor.trunk), layers_of(loss.actor.mlp))
    source = generator()
    next_noise, noise = (torch.randn(6, ACTIONS, generator=source) for _ in range(2))
    observation = torch.cat([td["features"], td["skill"]], 1)
    following = torch.cat([td["next", "features"], td["skill"]], 1)

    with torch.no_grad():
        action = truncated_normal(torch.tanh(actor(following)), next_noise)
        y = td["next", "reward"] + td["next", "discount"] * torch.min(*target(following, action))
    q1, q2 = critic(observation, td["action"])
    critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
    critic_gradients = torch.autograd.grad(critic_loss, critic_parameters)
    action = truncated_normal(torch.tanh(actor(observation)), noise)
    actor_loss = -torch.min(*critic(observation, action)).mean()
    actor_loss.backward()

    out = loss(td)
    torch.testing.assert_close(out["loss_qvalue"], critic_loss)
    torch.testing.assert_close(out["loss_actor"], actor_loss)
    torch.testing.assert_close(out["target_q_mean"], y.mean())
    torch.testing.assert_close(out["q_mean"], torch.cat([q1, q2]).mean())
    torch.testing.assert_close(out["td_error"], torch.maximum((q1 - y).abs(), (q2 - y).abs()).mean())
    (out["loss_qvalue"] + out["loss_actor"]).backward()
    for ours, expected in zip(loss.critic.parameters(), critic_gradients, strict=True):
        torch.testing.assert_close(ours.grad, expected)
    for ours, theirs in zip(loss.actor.parameters(), actor.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad)


def test_the_discount_of_the_batch_is_the_only_one() -> None:
    td, loss = skill_batch(), skill_ddpg()
    td["next", "discount"].zero_()
    assert loss(td)["target_q_mean"] == td["next", "reward"].mean()


def test_an_agent_that_does_not_fit_is_refused_with_its_value() -> None:
    actor = DeterministicActor(FEATURES, ACTIONS, skill_dim=3, hidden_dim=8)
    with pytest.raises(ValueError, match="built for 12 inputs, the actor sees 15"):
        SkillDDPGLoss(actor, TwinCritic(FEATURES, ACTIONS))
    with pytest.raises(ValueError, match=r"`noise_clip` must be at least 0, got -0\.1"):
        skill_ddpg(noise_clip=-0.1)

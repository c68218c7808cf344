"""SkillDDPGLoss against URLB's DDPG update, typed again with plain torch networks."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from loss_cases import ACTIONS, FEATURES, SKILLS, skill_batch, skill_ddpg
from torch import Tensor, nn

from crptpro.modules import DeterministicActor, FixedSkillActor, TwinCritic
from crptpro.objectives import SkillDDPGLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
STD, CLIP = 0.2, 0.3


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def mlp_of(module: nn.Module, trunk: nn.Module | None = None) -> nn.Module:
    layers = [] if trunk is None else [copy.deepcopy(trunk.linear), copy.deepcopy(trunk.norm), nn.Tanh()]
    first, middle, last = (copy.deepcopy(layer) for layer in (module.first, module.middle, module.last))
    return nn.Sequential(*layers, first, nn.ReLU(), middle, nn.ReLU(), last)


def critic_of(critic: TwinCritic):
    trunk = nn.Sequential(copy.deepcopy(critic.trunk.linear), copy.deepcopy(critic.trunk.norm), nn.Tanh())
    q1, q2 = mlp_of(critic.q1), mlp_of(critic.q2)

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


def test_both_losses_and_gradients_equal_the_released_update() -> None:
    loss, td = skill_ddpg(generator=generator()), skill_batch()
    with torch.no_grad():
        for parameter in loss.critic.parameters():  # the target differs from its source
            parameter.add_(0.1 * torch.randn_like(parameter))
    plain = TwinCritic(**loss.critic.config)
    plain.load_state_dict(
        {".".join(key) if isinstance(key, tuple) else key: value.data
         for key, value in loss.target_qvalue_network_params.items(True, True)}
    )  # fmt: skip
    target, _ = critic_of(plain)
    critic, critic_parameters = critic_of(loss.critic)
    actor = mlp_of(loss.actor.mlp, loss.actor.trunk)
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


@pytest.mark.parametrize(("noise", "expected"), [(10.0, 0.3), (-10.0, -0.3), (1.0, 0.2), (-0.5, -0.1)])
def test_learning_noise_is_clipped_at_three_tenths_and_exploring_noise_is_not(
    noise: float, expected: float
) -> None:
    actor = DeterministicActor(4, 2, skill_dim=3, hidden_dim=8)
    with torch.no_grad():
        for parameter in actor.mlp.last.parameters():
            parameter.zero_()  # acts 0
    inputs, noises = torch.randn(5, 7), torch.full((5, 2), noise)
    learned = actor.sample(inputs, noise=noises, noise_clip=CLIP)
    torch.testing.assert_close(learned, torch.full((5, 2), expected))
    explored = actor.sample(inputs, noise=noises)
    torch.testing.assert_close(explored, torch.full((5, 2), 0.2 * noise).clamp(-1 + 1e-6, 1 - 1e-6))


def test_where_the_bound_cuts_the_actor_still_learns() -> None:
    actor = DeterministicActor(4, 2, skill_dim=3, hidden_dim=8)
    with torch.no_grad():
        actor.mlp.last.bias.fill_(2.0)  # tanh(2) = 0.96
        actor.mlp.last.weight.zero_()
    action = actor.sample(torch.randn(5, 7), noise=torch.full((5, 2), 1.0), noise_clip=CLIP)
    assert torch.equal(action, torch.full_like(action, 1 - 1e-6))
    action.sum().backward()
    assert actor.mlp.last.bias.grad.abs().min() > 0


def test_skills_change_values_and_actions() -> None:
    td, other = skill_batch(), skill_batch()
    other["skill"] = other["skill"].roll(1, -1)
    loss = skill_ddpg(generator=generator())
    again = skill_ddpg(generator=generator())
    assert loss(td)["q_mean"] != again(other)["q_mean"]
    actor = loss.actor
    actions = [FixedSkillActor(actor, skill).mode(td["features"]) for skill in range(SKILLS)]
    assert not torch.equal(actions[0], actions[1])
    inputs = torch.cat([td["features"], F.one_hot(torch.tensor(1), SKILLS).float().expand(6, SKILLS)], 1)
    torch.testing.assert_close(actions[1], actor(inputs))


def test_a_fixed_skill_actor_is_rebuilt_from_its_config() -> None:
    actor = FixedSkillActor(DeterministicActor(FEATURES, ACTIONS, skill_dim=SKILLS, hidden_dim=8), 2)
    twin = FixedSkillActor.from_config(**actor.config)
    twin.load_state_dict(actor.state_dict())
    features = torch.randn(3, FEATURES)
    assert torch.equal(twin.mode(features), actor.mode(features))
    assert twin.action_dim == ACTIONS
    first, second = (actor.explore(features, generator=generator()) for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, actor.mode(features))


def test_the_discount_of_the_batch_is_the_only_one() -> None:
    td, loss = skill_batch(), skill_ddpg()
    td["next", "discount"].zero_()
    torch.testing.assert_close(loss._target(td), td["next", "reward"].squeeze(-1))


def test_what_does_not_fit_is_refused_with_its_value() -> None:
    actor = DeterministicActor(FEATURES, ACTIONS, skill_dim=SKILLS, hidden_dim=8)
    with pytest.raises(ValueError, match="built for 12 inputs, the actor sees 15"):
        SkillDDPGLoss(actor, TwinCritic(FEATURES, ACTIONS))
    with pytest.raises(ValueError, match=r"noise_clip must not be negative, got -0\.1"):
        skill_ddpg(noise_clip=-0.1)
    with pytest.raises(ValueError, match="3 skills, 0 to 2; got skill 3"):
        FixedSkillActor(actor, 3)


def test_priority_weights_scale_rows() -> None:
    td = skill_batch()
    weighted = td.copy()
    weights = torch.zeros(td.batch_size)
    weights[3] = 1.0
    weighted["priority_weight"] = weights
    rows = skill_ddpg(reduction="none", generator=generator())(td)
    loss = skill_ddpg(reduction="sum", generator=generator())(weighted)
    torch.testing.assert_close(loss["loss_qvalue"], rows["loss_qvalue"][3])
    torch.testing.assert_close(loss["loss_actor"], rows["loss_actor"][3])

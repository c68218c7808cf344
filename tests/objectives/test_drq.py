"""DrQLoss and AveragedSACLoss against DrQ's update, typed again with plain torch networks."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from loss_cases import ACTIONS, averaged_sac, drq, pixel_batch, two_view_batch
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from crptpro.modules import PixelCritic, PixelEncoder, TwinCritic, set_compute_dtype
from crptpro.objectives import DrQLoss, RADSACLoss
from crptpro.training.rad_sac_learner import RADSACLearner

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
VIEWS = ("pixels", "pixels_view")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise_of(count: int, draws: int) -> list[Tensor]:
    source = generator()
    return [torch.randn(count, ACTIONS, generator=source) for _ in range(draws)]


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


def head_of(trunk: nn.Module) -> nn.Module:
    """Linear, LayerNorm, tanh."""
    return nn.Sequential(copy.deepcopy(trunk.linear), copy.deepcopy(trunk.norm), nn.Tanh())


def layers_of(mlp: nn.Module) -> nn.Module:
    first, middle, last = (copy.deepcopy(layer) for layer in (mlp.first, mlp.middle, mlp.last))
    return nn.Sequential(first, nn.ReLU(), middle, nn.ReLU(), last)


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
        names = {
            ".".join(key[1:]): value.data
            for key, value in loss.target_qvalue_network_params.items(True, True)
        }
        fresh = PixelCritic(PixelEncoder(**loss.encoder.config), TwinCritic(**loss.critic.head.config))
        fresh.load_state_dict(names)
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


def disturbed() -> DrQLoss:
    """A loss whose target critic differs from its source everywhere."""
    loss = drq(generator=generator())
    disturb(loss)
    return loss


def disturb(loss: DrQLoss) -> None:
    with torch.no_grad():
        for parameter in loss.critic.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))


def test_all_losses_and_gradients_equal_the_released_update() -> None:
    loss, td = disturbed(), pixel_batch()
    twin = Retyped(loss)
    critic_loss, actor_loss, alpha_loss = twin.losses(td, noise_of(6, 3))
    out = loss(td)
    for key, expected in zip(
        ("loss_qvalue", "loss_actor", "loss_alpha"), (critic_loss, actor_loss, alpha_loss)
    ):
        torch.testing.assert_close(out[key], expected, rtol=1e-4, atol=1e-6)
    out["loss_qvalue"].backward()
    critic_loss.backward()
    pairs = [*zip(loss.encoder.parameters(), twin.critic.convs.parameters(), strict=True)]
    pairs += [*zip(loss.critic.head.parameters(), twin_heads(twin.critic), strict=True)]
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


def twin_heads(critic: Critic) -> list[nn.Parameter]:
    return [*critic.head.parameters(), *critic.q1.parameters(), *critic.q2.parameters()]


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


def test_a_soft_update_moves_convolutions_and_heads_of_the_target_and_nothing_else() -> None:
    loss = drq()
    updater = SoftUpdate(loss, tau=0.25)
    disturb(loss)
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    updater.step()
    moved = {name for name, value in loss.state_dict().items() if not torch.equal(value, before[name])}
    assert moved == {name for name in before if name.startswith("target_qvalue_network_params")}
    assert any("convs" in name for name in moved)
    assert any("trunk" in name for name in moved)
    for name in moved:
        source = before[name.removeprefix("target_")]
        torch.testing.assert_close(loss.state_dict()[name], 0.75 * before[name] + 0.25 * source)


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


def test_the_learner_trains_the_convolutions_with_the_critics_optimiser() -> None:
    loss = drq()
    learner = RADSACLearner(loss, learning_rate=1e-3)
    listed = {
        name: {id(p) for g in o.param_groups for p in g["params"]} for name, o in learner.optimizers.items()
    }
    convolutions = {id(parameter) for parameter in loss.encoder.parameters()}
    assert convolutions <= listed["critic"]
    assert not convolutions & listed["actor"]
    before = [parameter.clone() for parameter in loss.encoder.parameters()]
    learner.update(pixel_batch(), agent_step=1)  # no actor update
    assert not any(map(torch.equal, before, loss.encoder.parameters()))


def test_bf16_reaches_the_encoder_inside_the_critic_and_stays_close() -> None:
    td = pixel_batch()
    expected = drq(generator=generator())(td)
    loss = set_compute_dtype(drq(generator=generator()), torch.bfloat16)
    assert loss.encoder.compute_dtype == torch.bfloat16
    out = loss(td)
    torch.testing.assert_close(out["loss_qvalue"], expected["loss_qvalue"], rtol=0.1, atol=0.05)
    out["loss_qvalue"].backward()
    assert loss.encoder.convs[0].weight.grad.dtype == torch.float32


def test_a_critic_for_another_encoder_is_refused_with_both_lengths() -> None:
    loss = drq()
    with pytest.raises(ValueError, match=r"7 features, the encoder gives \d+"):
        DrQLoss(loss.encoder, loss.actor, TwinCritic(7, ACTIONS))

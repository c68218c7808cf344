"""RADSACLearner: what moves when, against the released update typed again with plain torch."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from host_reads import NoHostReads
from tensordict import TensorDict
from torch import Tensor, nn

from crptpro.modules import SquashedGaussianActor, TwinCritic
from crptpro.objectives import RADSACLoss
from crptpro.training.compiled import Compiled
from crptpro.training.rad_sac_learner import RADSACLearner

FEATURES, ACTIONS, ROWS = 12, 2, 6
SHAPE = {"bottleneck_dim": 5, "hidden_dim": 16}
RATE, TAU = 1e-2, 0.25


def batch(seed: int, dtype: torch.dtype = torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(ROWS, *shape, generator=generator, dtype=dtype)

    ends = torch.zeros(ROWS, 1, dtype=torch.bool)
    ends[1] = True
    following = {"features": draw(FEATURES), "reward": draw(1), "done": ends, "terminated": ends}
    return TensorDict({"features": draw(FEATURES), "action": draw(ACTIONS).tanh(), "next": following}, [ROWS])


def make_learner(seed: int = 0, **options: object) -> RADSACLearner:
    torch.manual_seed(seed)
    actor = SquashedGaussianActor(FEATURES, ACTIONS, **SHAPE)
    loss = RADSACLoss(
        actor, TwinCritic(FEATURES, ACTIONS, **SHAPE), generator=torch.Generator().manual_seed(seed)
    )
    return RADSACLearner(loss, **{"learning_rate": RATE, "critic_tau": TAU, **options})


def parts(learner: RADSACLearner) -> dict[str, list[Tensor]]:
    loss = learner.loss
    return {
        "critic": list(loss.critic.parameters()),
        "actor": list(loss.actor.parameters()),
        "temperature": [loss.log_alpha],
        "target": [value.data for value in loss.target_qvalue_network_params.values(True, True)],
    }


def moved(learner: RADSACLearner, agent_step: int) -> set[str]:
    """The parts that an update changes; every tensor of a part that moves must move."""
    before = {name: [tensor.clone() for tensor in tensors] for name, tensors in parts(learner).items()}
    learner.update(batch(agent_step), agent_step=agent_step)
    changed = set()
    for name, tensors in parts(learner).items():
        flags = {not torch.equal(old, new) for old, new in zip(before[name], tensors, strict=True)}
        assert len(flags) == 1, f"only some of {name} moved"
        changed |= {name} if flags.pop() else set()
    return changed


def test_the_critic_moves_every_time_and_the_others_on_their_intervals() -> None:
    learner = make_learner(actor_update_interval=2, target_update_interval=3)
    pairs = {"actor", "temperature"}
    schedule = [moved(learner, step) for step in range(6)]
    assert schedule == [
        {"critic", "target"} | pairs, {"critic"}, {"critic"} | pairs, {"critic", "target"}, {"critic"} | pairs,
        {"critic"},
    ]  # fmt: skip


def test_each_optimiser_counts_its_own_steps() -> None:
    learner = make_learner(actor_update_interval=2, target_update_interval=2)
    for step in range(5):
        learner.update(batch(step), agent_step=step)
    counts = {
        name: {int(state["step"]) for state in optimizer.state.values()}
        for name, optimizer in learner.optimizers.items()
    }
    assert counts == {"critic": {5}, "actor": {3}, "temperature": {3}}
    assert {group["lr"] for o in learner.optimizers.values() for group in o.param_groups} == {RATE}


def test_delayed_metrics_come_only_with_delayed_updates_and_nothing_carries_a_gradient() -> None:
    learner = make_learner()
    both, critic_only = (learner.update(batch(step), agent_step=step) for step in (0, 1))
    assert set(critic_only) == {"loss_qvalue", "q_mean", "target_q_mean", "td_error"}
    assert set(both) - set(critic_only) == {"loss_actor", "loss_alpha", "alpha", "entropy"}
    assert not any(value.requires_grad for value in both.values())


def policy(actor: nn.Module, features: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """pi(a|h) of the released code: squashed log-std, density of the pre-tanh sample."""
    mu, raw = actor.mlp(actor.trunk(features)).chunk(2, dim=-1)
    std = (-10 + 6 * (torch.tanh(raw) + 1)).exp()
    u = mu + std * noise
    density = torch.distributions.Normal(mu, std).log_prob(u) - 2 * (math.log(2) - u - F.softplus(-2 * u))
    return u.tanh(), density.sum(-1, keepdim=True)


class RetypedSAC:
    """The update of algorithms' equations: critic, then actor and temperature, then the target."""

    def __init__(self, learner: RADSACLearner) -> None:
        loss = learner.loss
        self.actor, self.critic = copy.deepcopy(loss.actor), copy.deepcopy(loss.critic)
        self.target = copy.deepcopy(loss.critic)
        self.log_alpha = loss.log_alpha.detach().clone().requires_grad_()
        self.noise = torch.Generator().manual_seed(0)
        groups = {"critic": self.critic.parameters(), "actor": self.actor.parameters()}
        self.adam = {name: torch.optim.Adam(group, lr=RATE) for name, group in groups.items()}
        self.adam["temperature"] = torch.optim.Adam([self.log_alpha], lr=RATE)

    def step(self, name: str, loss: Tensor) -> None:
        self.adam[name].zero_grad()
        loss.backward()
        self.adam[name].step()

    def draw(self) -> Tensor:
        return torch.randn(ROWS, ACTIONS, generator=self.noise, dtype=torch.float64)

    def update(self, td: TensorDict, *, delayed: bool) -> None:
        h, h_next = td["features"], td["next", "features"]
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            action, log_prob = policy(self.actor, h_next, self.draw())
            value = self.target(h_next, action).min(-1, keepdim=True).values - alpha * log_prob
            y = td["next", "reward"] + 0.99 * (~td["next", "terminated"]) * value
        q1, q2 = self.critic(h, td["action"]).split(1, -1)
        self.step("critic", F.mse_loss(q1, y) + F.mse_loss(q2, y))
        if not delayed:
            return
        action, log_prob = policy(self.actor, h, self.draw())
        self.step("actor", (alpha * log_prob - self.critic(h, action).min(-1, keepdim=True).values).mean())
        self.step("temperature", (self.log_alpha.exp() * (-log_prob.detach() + ACTIONS)).mean())
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters()):
                slow.mul_(1 - TAU).add_(TAU * fast)


@pytest.fixture
def _double() -> object:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("_double")
def test_updates_equal_the_equations_typed_again_with_the_target_moved_last() -> None:
    learner = make_learner()
    twin = RetypedSAC(learner)
    for step in range(4):  # 0 and 2 are delayed; 1 and 3 read a target that 0 and 2 moved
        td = batch(step, torch.float64)
        twin.update(td, delayed=step % 2 == 0)
        learner.update(td, agent_step=step)
        mine = parts(learner)
        assert mine["critic"][0].dtype is torch.float64
        theirs = {
            "critic": twin.critic.parameters(), "actor": twin.actor.parameters(),
            "temperature": [twin.log_alpha],
        }  # fmt: skip
        for name, expected in theirs.items():
            for ours, other in zip(mine[name], expected, strict=True):
                torch.testing.assert_close(ours, other, rtol=1e-7, atol=1e-10, msg=f"{name}, update {step}")
        targets = {
            ".".join(key): value for key, value in learner.loss.target_qvalue_network_params.items(True, True)
        }
        for key, value in twin.target.state_dict().items():
            (mine_key,) = [name for name in targets if name.endswith(key)]
            torch.testing.assert_close(targets[mine_key].data, value, rtol=1e-7, atol=1e-10)


def test_a_restored_learner_continues_bit_equal() -> None:
    first, second = make_learner(), make_learner(seed=1)
    for step in range(3):
        first.update(batch(step), agent_step=step)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.loss.generator.set_state(first.loss.generator.get_state())  # the loop keeps generators apart
    for step in range(3, 7):
        ours = first.update(batch(step), agent_step=step)
        theirs = second.update(batch(step), agent_step=step)
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    for name, tensors in parts(first).items():
        assert all(map(torch.equal, tensors, parts(second)[name])), name


def test_a_captured_update_computes_what_a_plain_one_does_and_reads_nothing_back() -> None:
    plain, captured = make_learner(), make_learner(captures=True)
    for step in range(5):
        expected = plain.update(batch(step), agent_step=step)
        with NoHostReads():
            found = captured.update(batch(step), agent_step=step)
        assert expected.keys() == found.keys()
        assert all(torch.equal(expected[key], found[key]) for key in expected)
    assert all(torch.equal(a, b) for a, b in zip(plain.loss.parameters(), captured.loss.parameters()))


def test_a_captured_learner_and_a_plain_one_continue_each_other() -> None:
    first, second = make_learner(captures=True), make_learner(seed=1)
    for step in range(2):
        first.update(batch(step), agent_step=step)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.loss.generator.set_state(first.loss.generator.get_state())
    assert not any(group["capturable"] for o in second.optimizers.values() for group in o.param_groups)
    for step in range(2, 4):
        for learner in (first, second):
            learner.update(batch(step), agent_step=step)
    assert all(torch.equal(a, b) for a, b in zip(first.loss.parameters(), second.loss.parameters()))


@pytest.mark.slow
def test_compiled_losses_agree_with_eager_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    torch._dynamo.reset()  # what other tests compiled of these losses confuses its guards (torch 2.13)
    compile = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **options: compile(f, backend="aot_eager", **options))
    plain, compiled = make_learner(), make_learner(compiled=Compiled(is_on=True))
    for step in range(4):
        expected = plain.update(batch(step), agent_step=step)
        found = compiled.update(batch(step), agent_step=step)
        torch.testing.assert_close(found, expected)
    for one, two in zip(plain.loss.parameters(), compiled.loss.parameters()):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-4)


def test_a_captured_update_reads_weights_and_masks_too() -> None:
    weighted = batch(0)
    weighted["priority_weight"] = torch.linspace(0, 1, ROWS)
    weighted["shifted_valid"] = torch.arange(ROWS) != 2
    losses = []
    for captures in (False, True):
        losses.append(make_learner(captures=captures).update(weighted, agent_step=0)["loss_qvalue"])
    unweighted = make_learner().update(batch(0), agent_step=0)["loss_qvalue"]
    assert torch.equal(*losses)
    assert not torch.isclose(losses[0], unweighted)

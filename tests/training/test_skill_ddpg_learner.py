from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from crptpro.modules import DeterministicActor, TwinCritic
from crptpro.objectives import SkillDDPGLoss
from crptpro.training.skill_ddpg_learner import SkillDDPGLearner

FEATURES, ACTIONS, SKILLS, ROWS = 12, 2, 3, 6
TAU = 0.25


def batch(seed: int) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(ROWS, *shape, generator=generator)

    following = {"features": draw(FEATURES), "reward": draw(1), "discount": torch.full((ROWS, 1), 0.97)}
    root = {"features": draw(FEATURES), "skill": torch.eye(ROWS, SKILLS), "action": draw(ACTIONS).tanh()}
    return TensorDict({**root, "next": following}, [ROWS])


def make_learner(seed: int = 0) -> SkillDDPGLearner:
    torch.manual_seed(seed)
    actor = DeterministicActor(FEATURES, ACTIONS, skill_dim=SKILLS, hidden_dim=16)
    critic = TwinCritic(FEATURES + SKILLS, ACTIONS, hidden_dim=16, has_tanh=True)
    loss = SkillDDPGLoss(actor, critic, generator=torch.Generator().manual_seed(seed))
    return SkillDDPGLearner(loss, learning_rate=1e-2, critic_tau=TAU)


def test_every_update_moves_critic_actor_and_then_the_target() -> None:
    learner = make_learner()
    loss = learner.loss
    for step in (3, 4):  # the number does not matter
        before = {name: value.clone() for name, value in loss.state_dict().items()}
        learner.update(batch(step), agent_step=step)
        for name, value in loss.state_dict().items():
            assert not torch.equal(value, before[name]), name
            if name.startswith("target_"):
                source = loss.state_dict()[name.removeprefix("target_")]  # the critic just stepped
                torch.testing.assert_close(value, (1 - TAU) * before[name] + TAU * source)


def test_the_actor_is_stepped_against_the_critic_just_stepped() -> None:
    learner, twin = make_learner(), make_learner()
    td = batch(0)
    twin._step("critic", twin.loss.critic_loss(td)["loss_qvalue"])
    expected = twin.loss.actor_loss(td)
    assert torch.equal(learner.update(td, agent_step=0)["loss_actor"], expected.detach())


def test_metrics_carry_no_gradient_and_defaults_are_the_released_ones() -> None:
    metrics = make_learner().update(batch(0), agent_step=0)
    assert set(metrics) == {"loss_qvalue", "loss_actor", "q_mean", "target_q_mean", "td_error"}
    assert not any(value.requires_grad for value in metrics.values())
    learner = SkillDDPGLearner(make_learner().loss)
    assert {group["lr"] for o in learner.optimizers.values() for group in o.param_groups} == {1e-4}


def test_a_restored_learner_continues_bit_equal() -> None:
    first, second = make_learner(), make_learner(seed=1)
    for step in range(3):
        first.update(batch(step), agent_step=step)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.loss.generator.set_state(first.loss.generator.get_state())
    for step in range(3, 6):
        ours, theirs = (learner.update(batch(step), agent_step=step) for learner in (first, second))
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_it_finds_the_best_action_of_a_bandit_per_skill() -> None:
    """Skill 0 is paid for acting up, skill 1 for acting down; nothing follows."""
    torch.manual_seed(0)
    actor = DeterministicActor(2, 1, skill_dim=2, hidden_dim=32)
    critic = TwinCritic(4, 1, hidden_dim=32, has_tanh=True)
    learner = SkillDDPGLearner(SkillDDPGLoss(actor, critic), learning_rate=3e-3)
    features, skill = torch.zeros(64, 2), torch.eye(2).repeat(32, 1)
    wanted = torch.tensor([[0.5], [-0.5]]).repeat(32, 1)
    for step in range(250):
        action = torch.rand(64, 1) * 2 - 1
        following = {
            "features": features,
            "reward": -(action - wanted).square(),
            "discount": torch.zeros(64, 1),
        }
        td = TensorDict({"features": features, "skill": skill, "action": action, "next": following}, [64])
        learner.update(td, agent_step=step)
    learned = actor(torch.cat([features[:2], torch.eye(2)], 1)).squeeze(-1)
    assert learned[0] > 0.25
    assert learned[1] < -0.25

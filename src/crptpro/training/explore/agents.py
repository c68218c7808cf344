"""The agents that explore: an actor with the learner that trains it, by name."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from crptpro.active_config import ActiveConfig
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.modules import DeterministicActor, SquashedGaussianActor, TwinCritic, set_compute_dtype
from crptpro.modules.deterministic_actor import with_skill
from crptpro.objectives import AveragedSACLoss, RADSACLoss, SkillDDPGLoss
from crptpro.training.rad_sac_learner import RADSACLearner
from crptpro.training.skill_ddpg_learner import SkillDDPGLearner

VIEWS: dict[NestedKey, NestedKey] = {"pixels_view": "pixels", ("next", "pixels_view"): ("next", "pixels")}


class ExploringAgent(Protocol):
    """What a member needs of its agent.

    Attributes:
        actor: for whoever takes it over.
        loss: owns all networks.
        views: second views that :meth:`update` reads the features of, with what they are views of.
    """

    @property
    def actor(self) -> nn.Module: ...  # noqa: D102
    @property
    def loss(self) -> nn.Module: ...  # noqa: D102
    @property
    def views(self) -> dict[NestedKey, NestedKey]: ...  # noqa: D102

    def act(self, features: Tensor, skill: Tensor | None) -> Tensor:
        """Return an exploring action ``[1, A]`` for features ``[1, D]``."""

    def update(self, batch: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Do one update on features and intrinsic rewards; returns detached scalars."""

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimisers and generator."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""


class SACExplorer:
    """SAC on detached features: the explorer of Proto-RL, and with two views of everything that of APT.

    Args:
        feature_dim: length of the features.
        action_dim: A.
        config: resolved.
        generator: source of all action noise.
        loss_class: :class:`~crptpro.objectives.RADSACLoss` or one with second views.

    Raises:
        CRPTproError: returns over several decisions.
    """

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        config: ActiveConfig,
        generator: torch.Generator,
        loss_class: type[RADSACLoss] = RADSACLoss,
    ) -> None:
        if (config.n_step or 1) != 1:
            raise CRPTproError(
                f"The explorer {config.agent} learns from single transitions, got n_step {config.n_step}; leave it "
                "out, or choose skill-ddpg."
            )
        bottleneck, hidden = config.bottleneck_dim, config.hidden_dim
        self.generator = generator
        actor = SquashedGaussianActor(feature_dim, action_dim, bottleneck_dim=bottleneck, hidden_dim=hidden)
        critic = TwinCritic(feature_dim, action_dim, bottleneck_dim=bottleneck, hidden_dim=hidden)
        self.actor = actor.to(config.device)
        self.loss = loss_class(
            self.actor,
            critic.to(config.device),
            gamma=config.discount,
            alpha_init=config.initial_temperature,
            generator=generator,
        )
        self.views = VIEWS if issubclass(loss_class, AveragedSACLoss) else {}
        self.learner = RADSACLearner(
            self.loss, learning_rate=config.agent_learning_rate, critic_tau=config.critic_tau
        )

    def act(self, features: Tensor, skill: Tensor | None) -> Tensor:
        """Sample the policy."""
        return self.actor.sample(features, generator=self.generator)[0]

    def update(self, batch: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Step critic, and every second update actor, temperature and target."""
        return self.learner.update(batch, agent_step=agent_step)

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimisers and generator."""
        return {"learner": self.learner.state_dict(), "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.learner.load_state_dict(state["learner"])
        self.generator.set_state(state["generator"])


class SkillDDPGExplorer:
    """Skill-conditioned DDPG on detached features: the explorer of BeCL.

    Args:
        feature_dim: length of the features.
        action_dim: A.
        config: resolved.
        generator: source of all action noise.

    Raises:
        CRPTproError: no number of skills.
    """

    def __init__(
        self, feature_dim: int, action_dim: int, config: ActiveConfig, generator: torch.Generator
    ) -> None:
        if config.skill_dim is None:
            raise CRPTproError("The explorer skill-ddpg needs skills; set skill_dim (BeCL: 16).")
        bottleneck, hidden = config.bottleneck_dim, config.hidden_dim
        self.generator = generator
        self.views: dict[NestedKey, NestedKey] = {}
        self.actor = DeterministicActor(
            feature_dim,
            action_dim,
            skill_dim=config.skill_dim,
            bottleneck_dim=bottleneck,
            hidden_dim=hidden,
        ).to(config.device)
        inputs = feature_dim + config.skill_dim
        critic = TwinCritic(
            inputs, action_dim, bottleneck_dim=bottleneck, hidden_dim=hidden, has_tanh=True
        ).to(config.device)
        self.loss = SkillDDPGLoss(self.actor, critic, generator=generator)
        self.learner = SkillDDPGLearner(
            self.loss, learning_rate=config.agent_learning_rate, critic_tau=config.critic_tau
        )
        self.discount = config.discount

    def act(self, features: Tensor, skill: Tensor | None) -> Tensor:
        """Return the skill's action with noise."""
        assert skill is not None
        return self.actor.sample(with_skill(features, skill), generator=self.generator)

    def update(self, batch: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Step critic, actor and target."""
        if batch.get(("next", "discount"), None) is None:  # single transitions
            going_on = ~batch["next", "terminated"]
            batch["next", "discount"] = self.discount * going_on.to(batch["next", "reward"])
        return self.learner.update(batch, agent_step=agent_step)

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimisers and generator."""
        return {"learner": self.learner.state_dict(), "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.learner.load_state_dict(state["learner"])
        self.generator.set_state(state["generator"])


_AGENTS: dict[str, Callable[[int, int, ActiveConfig, torch.Generator], ExploringAgent]] = {
    "rad-sac": SACExplorer,
    "averaged-sac": functools.partial(SACExplorer, loss_class=AveragedSACLoss),
    "skill-ddpg": SkillDDPGExplorer,
}


def require_agent(name: str | None) -> None:
    """Make sure that there is an agent of this name.

    Raises:
        UnknownNameError: naming the known ones.
    """
    if name not in _AGENTS:
        raise UnknownNameError(f"There is no exploring agent {name!r}; known: {', '.join(sorted(_AGENTS))}.")


def build_agent(
    config: ActiveConfig,
    *,
    feature_dim: int,
    action_dim: int,
    generator: torch.Generator,
    dtype: torch.dtype,
) -> ExploringAgent:
    """Build the agent that a run's settings name; weights come from torch's global generator.

    Args:
        config: resolved.
        feature_dim: length of the features.
        action_dim: of the domain.
        generator: source of the action noise.
        dtype: of the big products.

    Raises:
        UnknownNameError: naming the known agents.
    """
    require_agent(config.agent)
    agent = _AGENTS[str(config.agent)](feature_dim, action_dim, config, generator)
    set_compute_dtype(agent.loss, dtype)
    return agent

"""The agents that explore: an actor with the learner that trains it, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from crptpro.active_config import ActiveConfig
from crptpro.errors import UnknownNameError
from crptpro.modules import SquashedGaussianActor, TwinCritic, set_compute_dtype
from crptpro.objectives import RADSACLoss
from crptpro.training.rad_sac_learner import RADSACLearner


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
    """SAC on detached features (Proto-RL's explorer; algorithm of :class:`~crptpro.objectives.RADSACLoss`)."""

    views: dict[NestedKey, NestedKey] = {}  # noqa: RUF012 - never written

    def __init__(
        self, feature_dim: int, action_dim: int, config: ActiveConfig, generator: torch.Generator
    ) -> None:
        bottleneck, hidden = config.bottleneck_dim, config.hidden_dim
        self.generator = generator
        actor = SquashedGaussianActor(feature_dim, action_dim, bottleneck_dim=bottleneck, hidden_dim=hidden)
        critic = TwinCritic(feature_dim, action_dim, bottleneck_dim=bottleneck, hidden_dim=hidden)
        self.actor = actor.to(config.device)
        loss = RADSACLoss(
            self.actor,
            critic.to(config.device),
            gamma=config.discount,
            alpha_init=config.initial_temperature,
            generator=generator,
        )
        self.loss = loss
        self.learner = RADSACLearner(
            loss, learning_rate=config.agent_learning_rate, critic_tau=config.critic_tau
        )

    def act(self, features: Tensor, skill: Tensor | None) -> Tensor:
        """Sample the policy."""
        return self.actor.sample(features, generator=self.generator)[0]

    def update(self, batch: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Step critic, and every second time actor, temperature and target."""
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
}


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
    if config.agent not in _AGENTS:
        raise UnknownNameError(
            f"There is no exploring agent {config.agent!r}; known: {', '.join(sorted(_AGENTS))}."
        )
    agent = _AGENTS[config.agent](feature_dim, action_dim, config, generator)
    set_compute_dtype(agent.loss, dtype)
    return agent

"""What each downstream algorithm brings: who acts on features, who learns from batches, and on what schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from crptpro.downstream_config import SACSettings
from crptpro.modules import (
    DeterministicActor,
    FixedSkillActor,
    PixelEncoder,
    SquashedGaussianActor,
    TwinCritic,
)
from crptpro.modules.deterministic_actor import one_hot_skill
from crptpro.modules.placement import device_of
from crptpro.objectives import DrQLoss, RADSACLoss, SkillDDPGLoss
from crptpro.seeding import derive_seed
from crptpro.training.agent import FeatureActor
from crptpro.training.compiled import Compiled
from crptpro.training.rad_sac_learner import RADSACLearner
from crptpro.training.skill_ddpg_learner import SkillDDPGLearner


class Learner(Protocol):
    """Turns batches into updates."""

    @property
    def loss(self) -> LossModule:
        """The losses; everything that is trained is among its parameters."""
        ...

    def update(self, td: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Do one update before the decision ``agent_step`` is taken; returns detached scalars."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that training changes."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore it."""
        ...


@dataclass(frozen=True)
class DownstreamAlgorithm:
    """One algorithm, ready to act and learn.

    Attributes:
        actor: acts on features; deterministic when evaluated.
        explore: features ``[1, D]`` to the action that is taken while learning, ``[1, A]``.
        learner: what updates.
        trains_encoder: whether the encoder is among what it trains; batches then hold images in two views, not
            features.
        explores_at_once: whether the actor knows enough to act before its first update.
        update_interval: decisions between two updates.
        n_step: agent steps that a transition spans; the batch then carries ``("next", "discount")``. None for plain
            transitions.
        constants: entries that every row of every batch gets.
    """

    actor: FeatureActor
    explore: Callable[[Tensor], Tensor]
    learner: Learner
    trains_encoder: bool = False
    explores_at_once: bool = False
    update_interval: int = 1
    n_step: int | None = None
    constants: Mapping[str, Tensor] = field(default_factory=dict)


def make_algorithm(
    encoder: PixelEncoder,
    action_dim: int,
    config: SACSettings,
    *,
    seed: int,
    generator: torch.Generator,
    actor: SquashedGaussianActor | None = None,
    compiled: Compiled | None = None,
    captures: bool = False,
) -> DownstreamAlgorithm:
    """Build the algorithm that ``config.algorithm`` names, with fresh networks.

    Args:
        encoder: frozen, on the device where everything else goes too; an algorithm that trains its encoder thaws and
            trains this very one.
        action_dim: A.
        config: every number.
        seed: decides the skill where none is given.
        generator: source of all action noise.
        actor: of rad-sac, to start from instead of a fresh one.
        compiled: whether the losses are compiled; of rad-sac and drq, as the next.
        captures: whether updates are recorded as CUDA graphs.
    """
    if config.algorithm == "skill-ddpg":
        return _skill_ddpg(encoder, action_dim, config, seed, generator)
    trains_encoder = config.algorithm == "drq"
    fresh, critic = _sac_networks(encoder, action_dim, config, has_tanh=trains_encoder)
    options: dict[str, Any] = {
        "gamma": config.discount,
        "alpha_init": config.initial_temperature,
        "generator": generator,
    }
    loss: RADSACLoss
    if trains_encoder:
        loss = DrQLoss(encoder.requires_grad_(True), fresh, critic, **options)
    else:
        loss = RADSACLoss(fresh if actor is None else actor.to(device_of(critic)), critic, **options)
    learner = RADSACLearner(
        loss,
        learning_rate=config.learning_rate,
        critic_tau=config.critic_tau,
        actor_update_interval=config.actor_update_interval,
        target_update_interval=config.target_update_interval,
        compiled=compiled,
        captures=captures,
    )

    def explore(features: Tensor) -> Tensor:
        return loss.actor.sample(features, generator=generator)[0]

    return DownstreamAlgorithm(
        loss.actor,
        explore,
        learner,
        trains_encoder=trains_encoder,
        explores_at_once=actor is not None and not trains_encoder,
    )


def _sac_networks(
    encoder: PixelEncoder, action_dim: int, config: SACSettings, *, has_tanh: bool = False
) -> tuple[SquashedGaussianActor, TwinCritic]:
    device = encoder.conv_layers[0].weight.device
    widths: dict[str, Any] = {"bottleneck_dim": config.bottleneck_dim, "hidden_dim": config.hidden_dim}
    actor = SquashedGaussianActor(encoder.feature_dim, action_dim, has_tanh=has_tanh, **widths)
    critic = TwinCritic(encoder.feature_dim, action_dim, has_tanh=has_tanh, **widths)
    return actor.to(device), critic.to(device)


def _skill_ddpg(
    encoder: PixelEncoder, action_dim: int, config: SACSettings, seed: int, generator: torch.Generator
) -> DownstreamAlgorithm:
    own, device = config.skill_ddpg, encoder.conv_layers[0].weight.device
    widths: dict[str, Any] = {"bottleneck_dim": config.bottleneck_dim, "hidden_dim": config.hidden_dim}
    actor = DeterministicActor(
        encoder.feature_dim, action_dim, skill_dim=own.skill_dim, noise_std=own.noise_std, **widths
    )
    critic = TwinCritic(encoder.feature_dim + own.skill_dim, action_dim, has_tanh=True, **widths)
    loss = SkillDDPGLoss(actor.to(device), critic.to(device), noise_clip=own.noise_clip, generator=generator)
    skill = derive_seed(seed, "downstream", "skill") % own.skill_dim if own.skill is None else own.skill
    skilled = FixedSkillActor(actor, skill).to(device)
    return DownstreamAlgorithm(
        skilled,
        lambda features: skilled.explore(features, generator=generator),
        SkillDDPGLearner(loss, learning_rate=config.learning_rate, critic_tau=config.critic_tau),
        update_interval=own.update_interval,
        n_step=own.n_step,
        constants={"skill": one_hot_skill(skill, own.skill_dim).to(device)},
    )

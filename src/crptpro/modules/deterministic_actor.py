"""The deterministic actor of URLB's DDPG, with exploration noise of a fixed size, and one held at a skill."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.actor_critic import MLP, FeatureTrunk, standard_normal_like

BOUND_MARGIN = 1e-6


class DeterministicActor(nn.Module):
    r"""Policy :math:`a = \tanh(f([h, z]))` on features h and a one-hot skill z, plus Gaussian noise.

    Trunk (linear, LayerNorm, tanh), two hidden layers, orthogonal weights. Source: rll-research/url_benchmark
    ``agent/ddpg.py``; BeCL's downstream agent.

    Args:
        feature_dim: length of the features.
        action_dim: A.
        skill_dim: K, number of skills.
        bottleneck_dim: width after the trunk.
        hidden_dim: width of the two hidden layers.
        noise_std: standard deviation of the noise.
    """

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        *,
        skill_dim: int,
        bottleneck_dim: int = 50,
        hidden_dim: int = 1024,
        noise_std: float = 0.2,
    ) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.skill_dim = skill_dim
        self.noise_std = noise_std
        self.trunk = FeatureTrunk(feature_dim + skill_dim, bottleneck_dim, has_tanh=True)
        self.mlp = MLP(bottleneck_dim, hidden_dim, action_dim)
        self.config: dict[str, Any] = {
            "feature_dim": feature_dim,
            "action_dim": action_dim,
            "skill_dim": skill_dim,
            "bottleneck_dim": bottleneck_dim,
            "hidden_dim": hidden_dim,
            "noise_std": noise_std,
        }
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Orthogonal weights (gain 1), zero biases."""
        self.trunk.reset_parameters()
        self.mlp.reset_parameters()

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the action without noise, ``[*, A]`` in [-1, 1], for :func:`with_skill` of features and skill."""
        return torch.tanh(self.mlp(self.trunk(inputs)))

    def sample(
        self,
        inputs: Tensor,
        *,
        noise_clip: float | None = None,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Return a noisy action; the gradient passes as if nothing were clamped.

        Args:
            inputs: ``[*, feature_dim + skill_dim]``, see :func:`with_skill`.
            noise_clip: largest absolute noise; not limited if None.
            noise: standard normal ``[*, A]``; drawn if None.
            generator: source of the noise; torch's global generator if None.

        Returns:
            ``[*, A]`` in [-1 + 1e-6, 1 - 1e-6].
        """
        mean = self(inputs)
        if noise is None:
            noise = standard_normal_like(mean, generator)
        noise = noise * self.noise_std
        if noise_clip is not None:
            noise = noise.clamp(-noise_clip, noise_clip)
        action = mean + noise
        # Straight through: where the bound cuts, the mean still learns.
        return action + (action.clamp(-1 + BOUND_MARGIN, 1 - BOUND_MARGIN) - action).detach()


class FixedSkillActor(nn.Module):
    """A :class:`DeterministicActor` that is held at one skill, so that it acts on features alone.

    Args:
        actor: skill-conditioned.
        skill: which of its skills, from 0.

    Raises:
        ValueError: the actor has no such skill.
    """

    skill_code: Tensor

    def __init__(self, actor: DeterministicActor, skill: int) -> None:
        super().__init__()
        self.actor = actor
        self.skill = skill
        self.register_buffer("skill_code", one_hot_skill(skill, actor.skill_dim), persistent=False)

    @classmethod
    def from_config(cls, *, skill: int, **actor: Any) -> FixedSkillActor:
        """Build one from what :attr:`config` holds."""
        return cls(DeterministicActor(**actor), skill)

    @property
    def config(self) -> dict[str, Any]:
        """Arguments of :meth:`from_config`, JSON-able."""
        return {**self.actor.config, "skill": self.skill}

    @property
    def action_dim(self) -> int:
        """Length of an action."""
        return self.actor.action_dim

    def mode(self, features: Tensor) -> Tensor:
        """Evaluation action ``[*, A]``, without noise."""
        return self.actor(with_skill(features, self.skill_code))

    def explore(self, features: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """Noisy action ``[*, A]``; the noise is not clipped."""
        return self.actor.sample(with_skill(features, self.skill_code), generator=generator)


def one_hot_skill(skill: int, skill_dim: int) -> Tensor:
    """Return a skill as losses and networks read it, float32 ``[K]``.

    Args:
        skill: index in ``0..K - 1``.
        skill_dim: K.

    Raises:
        ValueError: an index outside the range.
    """
    if not 0 <= skill < skill_dim:
        raise ValueError(f"There are {skill_dim} skills, 0 to {skill_dim - 1}; got skill {skill}.")
    return F.one_hot(torch.tensor(skill), skill_dim).float()


def with_skill(features: Tensor, skill: Tensor) -> Tensor:
    """Append skills to features.

    Args:
        features: ``[*, D]``; their dtype is kept (a one-hot code is exact in all).
        skill: ``[*, K]`` or ``[K]``.

    Returns:
        ``[*, D + K]``.
    """
    skill = skill.to(features.dtype).expand(*features.shape[:-1], skill.shape[-1])
    return torch.cat([features, skill], dim=-1)

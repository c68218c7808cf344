"""Actor and twin critic on frozen features (the "RAD-SAC" agent of CRPTpro and Proto-RL)."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.heads import orthogonal_linear_
from crptpro.modules.precision import linear_in


class FeatureTrunk(nn.Module):
    """Linear layer and LayerNorm that bring long features down to a bottleneck.

    Source: the trunk of denisyarats/proto and liuxin0824/CRPTpro ``proto.py``; with tanh, that of
    denisyarats/drq ``drq.py`` and rll-research/url_benchmark ``agent/ddpg.py``.

    Args:
        feature_dim: input length.
        bottleneck_dim: output length.
        has_tanh: end with a tanh, as DrQ and URLB's DDPG do.
    """

    def __init__(self, feature_dim: int, bottleneck_dim: int = 50, *, has_tanh: bool = False) -> None:
        super().__init__()
        self.has_tanh = has_tanh
        self.linear = nn.Linear(feature_dim, bottleneck_dim)
        self.norm = nn.LayerNorm(bottleneck_dim)
        self.compute_dtype: torch.dtype = torch.float32

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Orthogonal weight, zero bias, unit LayerNorm."""
        orthogonal_linear_(self.linear)
        self.norm.reset_parameters()

    def forward(self, features: Tensor) -> Tensor:
        """Map ``[*, feature_dim]``, any floating dtype, to ``[*, bottleneck_dim]`` in the weights' dtype."""
        bottleneck = self.norm(linear_in(features, self.linear.weight, self.linear.bias, self.compute_dtype))
        return torch.tanh(bottleneck) if self.has_tanh else bottleneck


class MLP(nn.Module):
    """Three linear layers with ReLU between them, as behind each trunk of denisyarats/proto ``proto.py``.

    Args:
        in_dim: input length.
        hidden_dim: width of both hidden layers.
        out_dim: output length.
    """

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.first = nn.Linear(in_dim, hidden_dim)
        self.middle = nn.Linear(hidden_dim, hidden_dim)
        self.last = nn.Linear(hidden_dim, out_dim)
        self.compute_dtype: torch.dtype = torch.float32

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Orthogonal weights, zero biases."""
        for layer in (self.first, self.middle, self.last):
            orthogonal_linear_(layer)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``[*, in_dim]`` to ``[*, out_dim]``; only the wide middle product runs in ``compute_dtype``."""
        hidden = F.relu(self.first(inputs))
        hidden = F.relu(linear_in(hidden, self.middle.weight, self.middle.bias, self.compute_dtype))
        return self.last(hidden)


class SquashedGaussianActor(nn.Module):
    r"""Stochastic policy :math:`a = \tanh(u),\ u \sim \mathcal N(\mu, \sigma)` on features.

    The raw log standard deviation is squashed: ``log_std = lo + (hi - lo) / 2 * (tanh(raw) + 1)``.
    Log-probabilities score the pre-tanh sample, so they stay right at saturation.
    Source: denisyarats/proto and liuxin0824/CRPTpro ``proto.py``.

    Args:
        feature_dim: length of the features.
        action_dim: A.
        bottleneck_dim: width after the trunk.
        hidden_dim: width of the two hidden layers.
        log_std_bounds: range of the log standard deviation.
        has_tanh: end the trunk with a tanh, as DrQ does.
    """

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        *,
        bottleneck_dim: int = 50,
        hidden_dim: int = 1024,
        log_std_bounds: tuple[float, float] = (-10.0, 2.0),
        has_tanh: bool = False,
    ) -> None:
        super().__init__()
        low, high = log_std_bounds
        if not low < high:
            raise ValueError(f"log_std_bounds must be (low, high) with low < high, got {log_std_bounds}.")
        self.action_dim = action_dim
        self.log_std_bounds = (float(low), float(high))
        self.trunk = FeatureTrunk(feature_dim, bottleneck_dim, has_tanh=has_tanh)
        self.mlp = MLP(bottleneck_dim, hidden_dim, 2 * action_dim)
        self.config: dict[str, Any] = {
            "feature_dim": feature_dim,
            "action_dim": action_dim,
            "bottleneck_dim": bottleneck_dim,
            "hidden_dim": hidden_dim,
            "log_std_bounds": list(self.log_std_bounds),
            "has_tanh": has_tanh,
        }
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Orthogonal weights (gain 1), zero biases."""
        self.trunk.reset_parameters()
        self.mlp.reset_parameters()

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and standard deviation of the pre-tanh Gaussian.

        Args:
            features: ``[*, feature_dim]``.

        Returns:
            ``loc`` and ``scale``, each ``[*, A]``.
        """
        loc, raw = self.mlp(self.trunk(features)).chunk(2, dim=-1)
        return loc, squash_log_std(raw, self.log_std_bounds).exp()

    def sample(
        self, features: Tensor, *, noise: Tensor | None = None, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw reparameterised actions.

        Args:
            features: ``[*, feature_dim]``.
            noise: standard normal ``[*, A]``; drawn if None.
            generator: source of the noise; torch's global generator if None.

        Returns:
            ``action`` ``[*, A]`` in [-1, 1] and ``log_prob`` ``[*]`` (nats, summed over A).
        """
        loc, scale = self(features)
        if noise is None:
            noise = standard_normal_like(loc, generator)
        return squashed_gaussian(loc, scale, noise)

    def mode(self, features: Tensor) -> Tensor:
        """Evaluation action ``tanh(loc)``, ``[*, A]``."""
        return torch.tanh(self(features)[0])


class TwinCritic(nn.Module):
    """Two Q-functions that share ONE trunk, returned side by side.

    The 39,200 -> 50 trunk is shared and its output concatenated with the action, as in the released code; a
    target network is a copy of the whole critic, trunk included. Source: denisyarats/proto and
    liuxin0824/CRPTpro ``proto.py``.

    Args:
        feature_dim: length of the features.
        action_dim: A.
        bottleneck_dim: width after the trunk.
        hidden_dim: width of the two hidden layers of each head.
        has_tanh: end the trunk with a tanh, as DrQ and URLB's DDPG do.
    """

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        *,
        bottleneck_dim: int = 50,
        hidden_dim: int = 1024,
        has_tanh: bool = False,
    ) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.trunk = FeatureTrunk(feature_dim, bottleneck_dim, has_tanh=has_tanh)
        self.q1 = MLP(bottleneck_dim + action_dim, hidden_dim, 1)
        self.q2 = MLP(bottleneck_dim + action_dim, hidden_dim, 1)
        self.config: dict[str, Any] = {
            "feature_dim": feature_dim,
            "action_dim": action_dim,
            "bottleneck_dim": bottleneck_dim,
            "hidden_dim": hidden_dim,
            "has_tanh": has_tanh,
        }
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Orthogonal weights (gain 1), zero biases."""
        self.trunk.reset_parameters()
        self.q1.reset_parameters()
        self.q2.reset_parameters()

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return both action values.

        Args:
            features: ``[*, feature_dim]``.
            action: ``[*, A]`` in [-1, 1].

        Returns:
            ``[*, 2]``.
        """
        bottleneck = self.trunk(features)
        inputs = torch.cat([bottleneck, action.to(bottleneck.dtype)], dim=-1)
        return torch.cat([self.q1(inputs), self.q2(inputs)], dim=-1)


def squash_log_std(raw: Tensor, bounds: tuple[float, float]) -> Tensor:
    """Squash a raw output smoothly into ``bounds``: ``lo + (hi - lo) / 2 * (tanh(raw) + 1)``."""
    low, high = bounds
    return low + 0.5 * (high - low) * (torch.tanh(raw) + 1)


def squashed_gaussian(loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    r"""Reparameterised tanh-Gaussian sample and its log-density.

    :math:`\log\pi(a) = \sum_A \log\mathcal N(u;\mu,\sigma) - 2(\log 2 - u - \mathrm{softplus}(-2u))` with
    :math:`u = \mu + \sigma\epsilon`, evaluated at the pre-tanh sample: finite and with the right gradient
    even where tanh rounds to 1.

    Args:
        loc: ``[*, A]``.
        scale: ``[*, A]``, positive.
        noise: ``[*, A]``, standard normal.

    Returns:
        ``action`` ``[*, A]`` and ``log_prob`` ``[*]``.
    """
    pre_tanh = loc + scale * noise
    log_normal = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
    log_jacobian = 2 * (math.log(2) - pre_tanh - F.softplus(-2 * pre_tanh))
    return torch.tanh(pre_tanh), (log_normal - log_jacobian).sum(-1)


def standard_normal_like(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Standard normal values shaped, typed and placed like ``like``, from a generator if one is given."""
    if generator is None:
        return torch.randn_like(like)
    values = torch.randn(like.shape, generator=generator, dtype=like.dtype, device=generator.device)
    return values.to(like.device)

"""Actors and critics: the "RAD-SAC" agent of CRPTpro and Proto-RL, DrQ's critic of images, BeCL's skill policy.

Each is a trunk from ``feature_dim`` to ``bottleneck_dim``, and perceptrons with two hidden layers of ``hidden_dim``.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.encoder import PixelEncoder
from crptpro.modules.heads import LinearNetwork
from crptpro.modules.precision import linear_in
from crptpro.values import as_float


class FeatureTrunk(nn.Module):
    """Linear layer and LayerNorm from long features to a bottleneck; DrQ and URLB's DDPG end with a tanh."""

    def __init__(self, feature_dim: int, bottleneck_dim: int, *, has_tanh: bool) -> None:
        super().__init__()
        self.has_tanh = has_tanh
        self.linear = nn.Linear(feature_dim, bottleneck_dim)
        self.norm = nn.LayerNorm(bottleneck_dim)
        self.compute_dtype = torch.float32

    def forward(self, features: Tensor) -> Tensor:
        bottleneck = self.norm(linear_in(features, self.linear, self.compute_dtype))
        return torch.tanh(bottleneck) if self.has_tanh else bottleneck


class MLP(nn.Module):
    """Three linear layers with ReLU between them; only the wide middle product runs in ``compute_dtype``."""

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.first = nn.Linear(in_dim, hidden_dim)
        self.middle = nn.Linear(hidden_dim, hidden_dim)
        self.last = nn.Linear(hidden_dim, out_dim)
        self.compute_dtype = torch.float32

    def forward(self, inputs: Tensor) -> Tensor:
        hidden = F.relu(self.first(inputs))
        return self.last(F.relu(linear_in(hidden, self.middle, self.compute_dtype)))


class SquashedGaussianActor(LinearNetwork):
    r"""Stochastic policy :math:`a = \tanh(u),\ u \sim \mathcal N(\mu, \sigma)` on features.

    The raw log standard deviation is squashed: ``log_std = lo + (hi - lo) / 2 * (tanh(raw) + 1)``, with (lo, hi)
    ``log_std_bounds``. Source: denisyarats/proto and liuxin0824/CRPTpro ``proto.py``.
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
        super().__init__(
            feature_dim=feature_dim, action_dim=action_dim, bottleneck_dim=bottleneck_dim, hidden_dim=hidden_dim
        )
        feature_dim, self.action_dim, bottleneck_dim, hidden_dim = self.config.values()
        self.log_std_bounds = low, high = [as_float(bound, "log_std_bounds") for bound in log_std_bounds]
        if not low < high:
            raise ValueError(f"log_std_bounds must be (low, high) with low < high, got {log_std_bounds}.")
        self.config |= {"log_std_bounds": self.log_std_bounds, "has_tanh": bool(has_tanh)}
        self.trunk = FeatureTrunk(feature_dim, bottleneck_dim, has_tanh=has_tanh)
        self.mlp = MLP(bottleneck_dim, hidden_dim, 2 * self.action_dim)
        self.reset_parameters()

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of the pre-tanh Gaussian, each ``[*, A]``."""
        loc, raw = self.mlp(self.trunk(features)).chunk(2, dim=-1)
        low, high = self.log_std_bounds
        return loc, (low + 0.5 * (high - low) * (torch.tanh(raw) + 1)).exp()

    def sample(self, features: Tensor, *, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Return reparameterised actions ``[*, A]`` in [-1, 1], and their ``log_prob`` ``[*]`` (nats, summed over A).

        The noise is drawn from ``generator`` (torch's global one if None).
        """
        loc, scale = self(features)
        return squashed_gaussian(loc, scale, standard_normal_like(loc, generator))

    def mode(self, features: Tensor) -> Tensor:
        """Evaluation action ``tanh(loc)``, ``[*, A]``."""
        return torch.tanh(self(features)[0])


class TwinCritic(LinearNetwork):
    """Two Q-functions with one shared trunk, as in denisyarats/proto and liuxin0824/CRPTpro ``proto.py``."""

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        *,
        bottleneck_dim: int = 50,
        hidden_dim: int = 1024,
        has_tanh: bool = False,
    ) -> None:
        super().__init__(
            feature_dim=feature_dim, action_dim=action_dim, bottleneck_dim=bottleneck_dim, hidden_dim=hidden_dim
        )
        feature_dim, self.action_dim, bottleneck_dim, hidden_dim = self.config.values()
        self.config["has_tanh"] = bool(has_tanh)
        self.trunk = FeatureTrunk(feature_dim, bottleneck_dim, has_tanh=has_tanh)
        self.q1 = MLP(bottleneck_dim + self.action_dim, hidden_dim, 1)
        self.q2 = MLP(bottleneck_dim + self.action_dim, hidden_dim, 1)
        self.reset_parameters()

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return both values ``[*, 2]`` of features ``[*, feature_dim]`` and actions ``[*, A]`` in [-1, 1]."""
        bottleneck = self.trunk(features)
        inputs = torch.cat([bottleneck, action.to(bottleneck.dtype)], dim=-1)
        return torch.cat([self.q1(inputs), self.q2(inputs)], dim=-1)


class PixelCritic(nn.Module):
    """Twin Q-functions ``[*, 2]`` of images ``[*, C, H, W]`` and actions ``[*, A]`` in [-1, 1]."""

    def __init__(self, encoder: PixelEncoder, head: TwinCritic) -> None:
        super().__init__()
        if head.config["feature_dim"] != encoder.feature_dim:
            raise ValueError(
                f"The critic's head was built for {head.config['feature_dim']} features, the encoder gives "
                f"{encoder.feature_dim}; build it with feature_dim={encoder.feature_dim}."
            )
        self.encoder, self.head = encoder, head

    def forward(self, pixels: Tensor, action: Tensor) -> Tensor:
        return self.head(self.encoder(pixels), action)


class DeterministicActor(LinearNetwork):
    r"""Policy :math:`a = \tanh(f([h, z]))` on features h and a one-hot skill z of length K, plus Gaussian noise.

    BeCL's explorer; source: rll-research/url_benchmark ``agent/ddpg.py``.
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
        super().__init__(
            feature_dim=feature_dim, action_dim=action_dim, skill_dim=skill_dim, bottleneck_dim=bottleneck_dim,
            hidden_dim=hidden_dim,
        )  # fmt: skip
        feature_dim, self.action_dim, self.skill_dim, bottleneck_dim, hidden_dim = self.config.values()
        self.noise_std = as_float(noise_std, "noise_std", minimum=0)
        self.config["noise_std"] = self.noise_std
        self.trunk = FeatureTrunk(feature_dim + self.skill_dim, bottleneck_dim, has_tanh=True)
        self.mlp = MLP(bottleneck_dim, hidden_dim, self.action_dim)
        self.reset_parameters()

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the action without noise, ``[*, A]``, for features and skill in one row ``[*, feature_dim + K]``."""
        return torch.tanh(self.mlp(self.trunk(inputs)))

    def sample(
        self, inputs: Tensor, *, noise_clip: float | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return an action ``[*, A]`` in [-1 + 1e-6, 1 - 1e-6] with noise of at most ``noise_clip`` in magnitude.

        The noise is drawn from ``generator`` (torch's global one if None). The bounds have a straight-through gradient.
        """
        mean = self(inputs)
        noise = self.noise_std * standard_normal_like(mean, generator)
        if noise_clip is not None:
            noise = noise.clamp(-noise_clip, noise_clip)
        action = mean + noise
        return action + (action.clamp(-1 + 1e-6, 1 - 1e-6) - action).detach()


def squashed_gaussian(loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    r"""Reparameterised tanh-Gaussian sample ``[*, A]`` and its log-density ``[*]``, from mean, deviation and noise.

    :math:`\log\pi(a) = \sum_A \log\mathcal N(u;\mu,\sigma) - 2(\log 2 - u - \mathrm{softplus}(-2u))` with
    :math:`u = \mu + \sigma\epsilon`: finite, with the correct gradient, even where tanh rounds to 1.
    """
    pre_tanh = loc + scale * noise
    log_normal = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
    log_jacobian = 2 * (math.log(2) - pre_tanh - F.softplus(-2 * pre_tanh))
    return torch.tanh(pre_tanh), (log_normal - log_jacobian).sum(-1)


def standard_normal_like(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Return standard normal values with shape, dtype and device of ``like``, from a generator if one is given."""
    if generator is None:
        return torch.randn_like(like)
    values = torch.randn(like.shape, generator=generator, dtype=like.dtype, device=generator.device)
    return values.to(like.device)

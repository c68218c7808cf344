"""Actors and critics: the "RAD-SAC" agent of CRPTpro and Proto-RL, DrQ's critic of images, BeCL's skill policy."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Distribution, constraints

from crptpro.modules.encoder import PixelEncoder
from crptpro.modules.heads import OrthogonalNetwork, plain_sizes
from crptpro.modules.precision import linear_in
from crptpro.values import as_float

ATANH_MARGIN = 1e-6
BOUND_MARGIN = 1e-6


class FeatureTrunk(OrthogonalNetwork):
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

    def forward(self, features: Tensor) -> Tensor:
        """Map ``[*, feature_dim]``, any floating dtype, to ``[*, bottleneck_dim]`` in the weights' dtype."""
        bottleneck = self.norm(linear_in(features, self.linear, self.compute_dtype))
        return torch.tanh(bottleneck) if self.has_tanh else bottleneck


class MLP(OrthogonalNetwork):
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

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``[*, in_dim]`` to ``[*, out_dim]``; only the wide middle product runs in ``compute_dtype``."""
        hidden = F.relu(self.first(inputs))
        return self.last(F.relu(linear_in(hidden, self.middle, self.compute_dtype)))


class SquashedGaussianActor(OrthogonalNetwork):
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

    Raises:
        ValueError: a size that is no positive whole number, or bounds that are not ascending.
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
        low, high = (as_float(bound, "log_std_bounds") for bound in log_std_bounds)
        if not low < high:
            raise ValueError(f"log_std_bounds must be (low, high) with low < high, got {log_std_bounds}.")
        sizes = plain_sizes(
            feature_dim=feature_dim,
            action_dim=action_dim,
            bottleneck_dim=bottleneck_dim,
            hidden_dim=hidden_dim,
        )
        feature_dim, self.action_dim, bottleneck_dim, hidden_dim = sizes.values()
        self.config: dict[str, Any] = {**sizes, "log_std_bounds": [low, high], "has_tanh": bool(has_tanh)}
        self.log_std_bounds = (low, high)
        self.trunk = FeatureTrunk(feature_dim, bottleneck_dim, has_tanh=has_tanh)
        self.mlp = MLP(bottleneck_dim, hidden_dim, 2 * self.action_dim)
        self.reset_parameters()

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and standard deviation of the pre-tanh Gaussian.

        Args:
            features: ``[*, feature_dim]``.

        Returns:
            ``loc`` and ``scale``, each ``[*, A]``.
        """
        loc, raw = self.mlp(self.trunk(features)).chunk(2, dim=-1)
        low, high = self.log_std_bounds
        return loc, (low + 0.5 * (high - low) * (torch.tanh(raw) + 1)).exp()

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


class TwinCritic(OrthogonalNetwork):
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

    Raises:
        ValueError: a size that is no positive whole number.
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
        sizes = plain_sizes(
            feature_dim=feature_dim,
            action_dim=action_dim,
            bottleneck_dim=bottleneck_dim,
            hidden_dim=hidden_dim,
        )
        feature_dim, self.action_dim, bottleneck_dim, hidden_dim = sizes.values()
        self.config: dict[str, Any] = {**sizes, "has_tanh": bool(has_tanh)}
        self.trunk = FeatureTrunk(feature_dim, bottleneck_dim, has_tanh=has_tanh)
        self.q1 = MLP(bottleneck_dim + self.action_dim, hidden_dim, 1)
        self.q2 = MLP(bottleneck_dim + self.action_dim, hidden_dim, 1)
        self.reset_parameters()

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


class PixelCritic(nn.Module):
    """Twin Q-functions of pixels; a target network is a copy of all of it, convolutions included.

    Whoever acts may read the same encoder: that ties the convolutions, as in denisyarats/drq ``drq.py``.

    Args:
        encoder: images to features.
        head: features and actions to two values.

    Raises:
        ValueError: the head was built for features of another length.
    """

    def __init__(self, encoder: PixelEncoder, head: TwinCritic) -> None:
        super().__init__()
        if head.config["feature_dim"] != encoder.feature_dim:
            raise ValueError(
                f"The critic's head was built for {head.config['feature_dim']} features, the encoder gives "
                f"{encoder.feature_dim}; build it with feature_dim={encoder.feature_dim}."
            )
        self.encoder = encoder
        self.head = head

    def reset_parameters(self) -> None:
        """Re-initialise the encoder and the head."""
        self.encoder.reset_parameters()
        self.head.reset_parameters()

    def forward(self, pixels: Tensor, action: Tensor) -> Tensor:
        """Return both action values ``[*, 2]`` of images ``[*, C, H, W]`` and actions ``[*, A]`` in [-1, 1]."""
        return self.head(self.encoder(pixels), action)


class DeterministicActor(OrthogonalNetwork):
    r"""Policy :math:`a = \tanh(f([h, z]))` on features h and a one-hot skill z, plus Gaussian noise.

    Trunk (linear, LayerNorm, tanh), two hidden layers, orthogonal weights. Source: rll-research/url_benchmark
    ``agent/ddpg.py``; BeCL's exploring agent.

    Args:
        feature_dim: length of the features.
        action_dim: A.
        skill_dim: K, number of skills.
        bottleneck_dim: width after the trunk.
        hidden_dim: width of the two hidden layers.
        noise_std: standard deviation of the noise.

    Raises:
        ValueError: a size that is no positive whole number, or a negative ``noise_std``.
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
        sizes = plain_sizes(
            feature_dim=feature_dim,
            action_dim=action_dim,
            skill_dim=skill_dim,
            bottleneck_dim=bottleneck_dim,
            hidden_dim=hidden_dim,
        )
        feature_dim, self.action_dim, self.skill_dim, bottleneck_dim, hidden_dim = sizes.values()
        self.noise_std = as_float(noise_std, "noise_std", minimum=0)
        self.config: dict[str, Any] = {**sizes, "noise_std": self.noise_std}
        self.trunk = FeatureTrunk(feature_dim + self.skill_dim, bottleneck_dim, has_tanh=True)
        self.mlp = MLP(bottleneck_dim, hidden_dim, self.action_dim)
        self.reset_parameters()

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


class SquashedGaussian(Distribution):
    """tanh of a diagonal Gaussian, in the form that TorchRL's probabilistic modules expect.

    Log-probabilities of the distribution's own last sample (recognised by identity) use its pre-tanh noise and
    are right at saturation; their gradient passes through the sample if it was reparameterised (``rsample``)
    and takes it as given otherwise (``sample``). Any other action is inverted with a margin of 1e-6 from the
    bounds.

    Args:
        loc: ``[*, A]``.
        scale: ``[*, A]``, positive.

    Examples:
        >>> policy = SquashedGaussian(torch.zeros(3, 2), torch.ones(3, 2))
        >>> action = policy.rsample()
        >>> policy.log_prob(action).shape
        torch.Size([3])
    """

    arg_constraints = {"loc": constraints.real, "scale": constraints.positive}  # noqa: RUF012 - torch's convention
    support = constraints.independent(constraints.interval(-1.0, 1.0), 1)
    has_rsample = True

    def __init__(self, loc: Tensor, scale: Tensor, validate_args: bool | None = False) -> None:
        self.loc, self.scale = loc, scale
        self._last: tuple[Tensor, Tensor] | None = None
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    @property
    def mode(self) -> Tensor:
        """The evaluation action ``tanh(loc)`` (the density's own mode has no closed form)."""
        return torch.tanh(self.loc)

    @property
    def mean(self) -> Tensor:
        """Same as :attr:`mode`: an approximation."""
        return self.mode

    @property
    def deterministic_sample(self) -> Tensor:
        """What TorchRL's deterministic exploration takes."""
        return self.mode

    def rsample(self, sample_shape: torch.Size | list[int] | tuple[int, ...] = ()) -> Tensor:
        """Draw reparameterised actions ``[*sample_shape, *, A]``."""
        loc = self.loc.expand(*sample_shape, *self.loc.shape)
        noise = standard_normal_like(loc, None)
        action, _ = squashed_gaussian(loc, self.scale.expand_as(loc), noise)
        self._last = (action, noise)
        return action

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density ``[*]`` of actions ``[*, A]`` in [-1, 1]."""
        if self._last is not None and value is self._last[0]:
            noise = self._last[1]
            if not value.requires_grad:
                # The action is given: it stays where it is while the parameters move, so the noise must follow.
                # Only its gradient is taken from the inversion, which rounds where loc is large beside scale.
                pre_tanh = (self.loc + self.scale * noise).detach()
                inverted = (pre_tanh - self.loc) / self.scale
                noise = noise + (inverted - inverted.detach())
            return squashed_gaussian(self.loc, self.scale, noise)[1]
        pre_tanh = torch.atanh(value.clamp(-1 + ATANH_MARGIN, 1 - ATANH_MARGIN))
        return squashed_gaussian(self.loc, self.scale, (pre_tanh - self.loc) / self.scale)[1]


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

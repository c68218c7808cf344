"""The actor's action distribution in the form that TorchRL's probabilistic modules expect."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from crptpro.modules.actor_critic import squashed_gaussian, standard_normal_like

ATANH_MARGIN = 1e-6


class SquashedGaussian(Distribution):
    """tanh of a diagonal Gaussian; samples are scored before the tanh.

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

"""Particle entropy from neighbour distances, and the running moments that set its scale (APT)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def particle_entropy(distances: Tensor, *, scale: float | Tensor = 1.0, clip: float = 0.0) -> Tensor:
    r"""Return :math:`\log(1 + \overline{\mathrm{relu}(d/scale - clip)})` (APT, arXiv 2103.04551).

    Form of rll-research/url_benchmark ``utils.py``: division and clipping act on each distance, the average
    over the k neighbours comes after, the logarithm last.

    Args:
        distances: ``[N, k]``, of each particle to its neighbours.
        scale: positive; a running statistic of the distances, kept by the caller.
        clip: subtracted before the relu.

    Returns:
        ``[N]``, non-negative.
    """
    return torch.log1p(F.relu(distances / scale - clip).mean(dim=-1))


def merge_moments(
    mean: Tensor, variance: Tensor, count: Tensor, values: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Take a batch of values into running moments, by the parallel rule of Chan et al. (1979).

    With :math:`\delta = \bar x - \mu`, n values so far and m new ones:

    .. math::
        \mu' = \mu + \delta \frac{m}{n + m}, \qquad
        \sigma'^2 = \frac{n \sigma^2 + m s^2 + \delta^2 n m / (n + m)}{n + m}

    As in rll-research/url_benchmark ``utils.py`` (``RMS``), :math:`s^2` is the batch's unbiased variance.

    Args:
        mean: :math:`\mu`, a scalar.
        variance: :math:`\sigma^2`, a scalar.
        count: n, a scalar; a fraction is a weak prior.
        values: at least two, of any shape.

    Returns:
        The new mean, variance and count.
    """
    values = values.to(mean).reshape(-1)
    new = values.numel()
    total = count + new
    delta = values.mean() - mean
    spread = variance * count + values.var() * new + delta.square() * count * new / total
    return mean + delta * new / total, spread / total, total

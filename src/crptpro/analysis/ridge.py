"""Ridge regression in closed form for more features than samples, judged on samples it has not seen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

#: Ridge penalties that are tried, in units of the mean eigenvalue of the training samples' Gram matrix.
PENALTIES = tuple(10.0**power for power in range(-6, 3))

_BLOCK = 4096
"""Features that are taken to float64 at a time: all at once would take gigabytes."""
_ROWS = 128
"""Of a Gram matrix at a time; the fewer, the less is computed twice."""


class RidgeFit(NamedTuple):
    """How well each target is predicted."""

    r2: Tensor
    """``[T]`` on the held-out samples: 1 - squared error / squared deviation from their own mean. At most 1, 0 for a
    constant at their mean, negative for what is worse."""
    penalty: Tensor
    """``[T]``, what was chosen from ``PENALTIES``."""


def standardized_gram(features: Tensor, train: Tensor) -> Tensor:
    """Return the inner products of all samples' standardised features, summed in float64.

    Each feature is centred at the training samples' mean and divided by their standard deviation plus the root mean
    square of all features' deviations. That summand matters for ReLU features: one that is active in a handful of
    samples would become a large number that says which sample this is. Without it, the R2 of velocities from 39,200
    features fell from 0.6 to 0.

    Args:
        features: ``[N, D]``, any floating dtype.
        train: int64 or bool, which rows are training samples.

    Returns:
        float64 ``[N, N]``.
    """
    moments = [torch.var_mean(block[train], 0, correction=0) for block in _blocks(features)]
    deviations = [variance.sqrt() for variance, _ in moments]
    usual = torch.cat(deviations).square().mean().sqrt()
    gram = torch.zeros(len(features), len(features), dtype=torch.float64, device=features.device)
    if not usual:
        return gram
    for block, deviation, (_, mean) in zip(_blocks(features), deviations, moments):
        _add_products(gram, block.sub_(mean).div_(deviation + usual))
    return _mirrored(gram)


def _blocks(features: Tensor) -> Iterator[Tensor]:
    """Copies of some features at a time, in float64."""
    for block in features.split(_BLOCK, dim=1):
        yield block.to(torch.float64, copy=True)


def _add_products(gram: Tensor, block: Tensor) -> None:
    """Add the rows' inner products on and above the diagonal: those below are the same."""
    for start in range(0, len(block), _ROWS):
        gram[start : start + _ROWS, start:].addmm_(block[start : start + _ROWS], block[start:].T)


def _mirrored(gram: Tensor) -> Tensor:
    return gram.triu() + gram.triu(1).T


def fit_ridge(gram: Tensor, targets: Tensor, train: Tensor, validation: Tensor, test: Tensor) -> RidgeFit:
    """Fit each target on the training samples and judge it on the test samples.

    The penalty of each target is the one that predicts the validation samples best when the training samples alone are
    fitted; with it, training and validation samples together are fitted, and the test samples predicted once.

    Args:
        gram: ``[N, N]``, inner products of the samples' features.
        targets: ``[N, T]``, none constant among the test samples.
        train: int64, rows to fit.
        validation: int64, rows to choose the penalty by.
        test: int64, rows to judge by.
    """
    gram, targets = gram.double(), targets.double()
    errors = torch.stack(
        [(p - targets[validation]).square().sum(0) for p in _predictions(gram, targets, train, validation)]
    )
    best = errors.argmin(0)
    predicted = torch.stack(list(_predictions(gram, targets, torch.cat([train, validation]), test)))
    chosen = predicted[best, :, torch.arange(targets.shape[1])].T
    truth = targets[test]
    residual = (chosen - truth).square().sum(0)
    r2 = 1 - residual / (truth - truth.mean(0)).square().sum(0)
    return RidgeFit(r2, torch.tensor(PENALTIES, dtype=torch.float64)[best.cpu()])


def _predictions(gram: Tensor, targets: Tensor, fitted: Tensor, asked: Tensor) -> list[Tensor]:
    """Return predictions ``[A, T]`` for each penalty; features are centred at the fitted samples' mean."""
    inner, across = gram[fitted][:, fitted], gram[asked][:, fitted]
    row_means = inner.mean(0)
    across = across - across.mean(1, keepdim=True) - row_means + row_means.mean()
    inner = inner - row_means - row_means[:, None] + row_means.mean()
    values, vectors = torch.linalg.eigh(inner)
    values = values.clamp(min=0)
    mean = targets[fitted].mean(0)
    loadings, projected = vectors.T @ (targets[fitted] - mean), across @ vectors
    scale = (
        values.mean() if values.any() else values.new_ones(())
    )  # features that say nothing predict the mean
    return [mean + projected @ (loadings / (values + penalty * scale)[:, None]) for penalty in PENALTIES]


def effective_rank(features: Tensor) -> float:
    """Return the exponential of the entropy of the centred samples' normalised singular values.

    Between 1 (all on a line) and min(N - 1, D); 0 if all samples coincide. Source: Roy and Vetterli, "The effective
    rank: a measure of effective dimensionality", 2007.

    Args:
        features: ``[N, D]``.

    Examples:
        >>> round(effective_rank(torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]])), 6)
        2.0
    """
    gram = torch.zeros(len(features), len(features), dtype=torch.float64, device=features.device)
    for block in _blocks(features):
        _add_products(gram, block.sub_(block.mean(0)))
    singular = torch.linalg.eigvalsh(_mirrored(gram)).clamp(min=0).sqrt()
    # Squaring has cost half of the digits: what is below is rounding.
    singular = singular[singular > 1e-7 * singular.max()]
    if not len(singular):
        return 0.0
    return float(torch.special.entr(singular / singular.sum()).sum().exp())


def mean_cosine(features: Tensor) -> float:
    """Return the mean cosine between different samples' features; 1 if all point the same way, 0 for one sample.

    What :func:`crptpro.objectives.metrics.mean_pairwise_cosine` is, summed in float64 a few features at a time. A
    sample whose features are all 0 has the cosine 0 with every other.

    Args:
        features: ``[N, D]``, any floating dtype.
    """
    if len(features) < 2:
        return 0.0
    squares = sum(
        (block.square().sum(1) for block in _blocks(features)), features.new_zeros((), dtype=torch.float64)
    )
    scale = squares.sqrt().clamp(min=1e-12).reciprocal()
    of_sum = sum((scale @ block).square().sum() for block in _blocks(features))
    return float(of_sum - (scale.square() * squares).sum()) / (len(features) * (len(features) - 1))

"""Cheap diagnostics of prototypes, assignments and embeddings; all without gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from crptpro.objectives.functional import prototype_dispersion


@torch.no_grad()
def assignment_entropy(assignments: Tensor) -> Tensor:
    """Mean entropy of the rows in nats, in [0, ln M]; ln M means that assignments say nothing.

    Args:
        assignments: ``[B, M]``, rows sum to 1.
    """
    return torch.special.entr(assignments).sum(dim=-1).mean()


@torch.no_grad()
def prototypes_in_use(assignments: Tensor) -> Tensor:
    """Number of prototypes that are the largest assignment of at least one sample, as a float scalar.

    In a collapsed run all assignments tie and the count is rounding; read it beside the entropy.

    Args:
        assignments: ``[B, M]``.
    """
    used = assignments.new_zeros(assignments.shape[-1])
    return used.index_fill(0, assignments.argmax(dim=-1), 1.0).sum()


@torch.no_grad()
def mean_pairwise_cosine(unit_rows: Tensor) -> Tensor:
    """Mean cosine over all ordered pairs of different rows; 1 means that all embeddings coincide.

    Computed from the norm of the sum, O(BD). A single row gives 0.

    Args:
        unit_rows: ``[B, D]`` l2-normalised.
    """
    count = unit_rows.shape[0]
    return _off_diagonal_sum(unit_rows) / max(count * (count - 1), 1)


@torch.no_grad()
def prototype_ane(prototypes: Tensor) -> Tensor:
    """Average negative-pair cosine: sum over j != k of c_j . c_k, divided by M^2 (the paper's ANE).

    Args:
        prototypes: ``[M, D]`` unit rows.
    """
    return _off_diagonal_sum(prototypes) / prototypes.shape[0] ** 2


@torch.no_grad()
def prototype_kne(prototypes: Tensor, *, k: int = 3) -> Tensor:
    """Mean over prototypes of the cosine to the k-th nearest other prototype (the paper's KNE).

    The paper does not state k. With k = 3, 512 spread vectors in 128 dimensions give about +0.2; its negative
    values only fit a median-like k near M / 2.

    Args:
        prototypes: ``[M, D]`` unit rows.
        k: which neighbour, the prototype itself not counted; at most M - 1.

    Raises:
        ValueError: ``k`` out of range.
    """
    count = prototypes.shape[0]
    if not 1 <= k < count:
        raise ValueError(f"k must be between 1 and {count - 1} for {count} prototypes, got {k}.")
    itself = torch.eye(count, dtype=torch.bool, device=prototypes.device)
    cosines = (prototypes @ prototypes.T).masked_fill(itself, float("-inf"))
    return cosines.topk(k, dim=-1).values[:, -1].mean()


@torch.no_grad()
def prototype_metrics(prototypes: Tensor, *, offset: float = 1.5) -> dict[str, Tensor]:
    """ANE, KNE at k = 3 and k = M / 2, and the dispersion (mean over all entries), as scalars.

    Args:
        prototypes: ``[M, D]``, rows of any length, M at least 4.
        offset: w of the dispersion.

    Returns:
        Keys ``prototype_ane``, ``prototype_kne_3``, ``prototype_kne_half``, ``prototype_dispersion``.

    Examples:
        >>> sorted(prototype_metrics(torch.eye(8)))
        ['prototype_ane', 'prototype_dispersion', 'prototype_kne_3', 'prototype_kne_half']
    """
    unit = torch.nn.functional.normalize(prototypes, dim=-1)
    return {
        "prototype_ane": prototype_ane(unit),
        "prototype_kne_3": prototype_kne(unit, k=3),
        "prototype_kne_half": prototype_kne(unit, k=prototypes.shape[0] // 2),
        "prototype_dispersion": prototype_dispersion(unit, offset=offset),
    }


def _off_diagonal_sum(rows: Tensor) -> Tensor:
    return rows.sum(dim=0).square().sum() - rows.square().sum()

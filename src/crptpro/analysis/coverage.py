"""Coverage of observations: a particle estimate of the entropy of their embeddings."""

from __future__ import annotations

import torch
from torch import Tensor

from crptpro.objectives.functional import knn_distances, particle_entropy


@torch.no_grad()
def coverage(embeddings: Tensor, *, k: int = 12) -> float:
    r"""Return the mean of :math:`\log(1 + \frac1k\sum_{j=1}^k \lVert z_i - z_i^{(j)}\rVert)` over observations.

    :math:`z_i^{(j)}` is the j-th nearest other embedding, as in the rewards of APT (arXiv 2103.04551) and Proto-RL
    (arXiv 2102.11271). The paper plots "a particle-based estimator" and states neither k, nor the number of
    observations, nor the encoder: these are this project's choice. The value falls with the number of observations:
    compare equal numbers. It is 0 if all embeddings are equal, and at most log 3 for unit vectors. Embeddings are
    ``[N, D]``; N of at most ``k``, the number of neighbours, raises a ``ValueError``.
    """
    if len(embeddings) <= k:
        raise ValueError(f"{k} neighbours need more than {k} observations, got {len(embeddings)}.")
    total = 0.0
    for part in embeddings.split(64):  # the differences to all neighbours would not fit in memory
        distances = knn_distances(part, embeddings, k=k + 1)[:, 1:]  # the nearest is the observation itself
        total += float(particle_entropy(distances).double().sum())
    return total / len(embeddings)

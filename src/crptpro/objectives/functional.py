"""The mathematics of every objective as pure functions on plain tensors.

``scores`` are cosine similarities before division by a temperature. No function needs a host synchronisation;
non-finite input gives non-finite output.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Reduction = Literal["none", "mean", "sum"]
DispersionReduction = Literal["mean_all", "sum", "mean_offdiag"]


@torch.no_grad()
def sinkhorn_knopp(scores: Tensor, *, temperature: float | Tensor = 0.1, iterations: int = 3) -> Tensor:
    r"""Soft assignments with evenly loaded prototypes (CRPTpro Eq. 4-6; SwaV, arXiv 2006.09882), ``[B, M]``.

    From :math:`\exp(s/\tau)` of the scores ``[B, M]``, every iteration scales the prototype marginal to 1/M and the
    sample marginal to 1/B (0 ``iterations`` give a softmax); rows of the result sum to 1. No gradient. Computed in the
    log domain, in float32 or wider: equal to the released code's form wherever that is finite.

    Deviation: the paper's Eq. 4 prints the scores without the exponential, which would divide by sums near 0.
    """
    log_q = _at_least_float32(scores) / temperature
    for _ in range(iterations):
        # The constants 1/M and 1/B of the marginals cancel in the final normalisation.
        log_q = log_q - log_q.logsumexp(dim=0, keepdim=True)
        log_q = log_q - log_q.logsumexp(dim=1, keepdim=True)
    return log_q.softmax(dim=1)


def comparative_loss(
    student_scores: Tensor, assignments: Tensor, *, temperature: float | Tensor = 0.1, reduction: Reduction = "mean"
) -> Tensor:
    r"""Cross-entropy between target assignments and predicted ones (CRPTpro Eq. 1 and 7), both ``[B, M]``, in nats.

    :math:`L_{comp} = -\frac1B\sum_i\sum_j q_{ij}\log\mathrm{softmax}_j(s_{ij}/\tau)`, or ``[B]`` for ``"none"``.
    Uniform prediction gives ln M (6.238 for 512).
    """
    log_p = F.log_softmax(_at_least_float32(student_scores) / temperature, dim=-1)
    return _reduced(-(assignments * log_p).sum(dim=-1), reduction)


def prototype_dispersion(
    prototypes: Tensor, *, offset: float | Tensor = 1.5, reduction: DispersionReduction = "mean_all"
) -> Tensor:
    r"""Intrinsic loss that pushes prototypes apart (CRPTpro Eq. 9), of unit rows ``[M, D]``.

    :math:`L_{intr} = \frac1{M^2}\sum_{j\ne k} \mathrm{sg}(c_j)\cdot c_k / (\mathrm{sg}(c_j\cdot c_k) + w)`, about
    -0.0023 to -0.0028 at orthogonal initialisation of 512 x 128. The ``offset`` w exceeds 1, so that the denominator is
    positive. ``"mean_all"`` divides by M^2, ``"mean_offdiag"`` by M(M-1), ``"sum"`` by nothing.

    Deviation: the paper prints a sum, but its table only fits the mean over all M x M entries, the default.
    """
    count = prototypes.shape[0]
    divisors = {"mean_all": count * count, "mean_offdiag": max(count * (count - 1), 1), "sum": 1}
    if reduction not in divisors:
        raise ValueError(f"reduction must be one of {', '.join(divisors)}, got {reduction!r}.")
    cosines = prototypes.detach() @ prototypes.T  # (M, D) x (D, M) -> (M, M)
    ratio = cosines / (cosines.detach() + offset)
    return ratio.masked_fill(_diagonal(count, prototypes), 0.0).sum() / divisors[reduction]


def knn_distances(queries: Tensor, keys: Tensor, *, k: int) -> Tensor:
    """Euclidean distances ``[N, k]`` of queries ``[N, D]`` to the k nearest of keys ``[K, D]``, ascending.

    They are found by a matrix product, which is inexact near zero, and recomputed from differences: a key equal to the
    query is at exactly 0. Fewer keys than ``k`` raise a ``ValueError``.
    """
    if not 1 <= k <= keys.shape[0]:
        raise ValueError(f"k must be between 1 and the number of keys {keys.shape[0]}, got {k}.")
    nearest = torch.cdist(queries, keys).topk(k, dim=-1, largest=False).indices  # (N, k)
    exact = (queries.unsqueeze(1) - keys[nearest]).norm(dim=-1)  # (N, 1, D) - (N, k, D) -> (N, k)
    return exact.sort(dim=-1).values


def knn_distance(queries: Tensor, keys: Tensor, *, k: int) -> Tensor:
    """Euclidean distance ``[N]`` to the k-th nearest key, including copies of the query: CRPTpro's reward (Eq. 11)."""
    return knn_distances(queries, keys, k=k)[:, -1]


def particle_reward(
    features: Tensor,
    *,
    k: int = 12,
    keys: Tensor | None = None,
    average: bool = True,
    scale: float | Tensor = 1.0,
    clip: float = 0.0,
) -> Tensor:
    """Return :func:`particle_entropy` of the distances of features ``[N, D]`` to the k nearest of ``keys`` ``[K, D]``.

    The keys are by default the features; ``average=False`` uses the k-th distance alone.
    """
    distances = knn_distances(features, features if keys is None else keys, k=k)
    return particle_entropy(distances if average else distances[:, -1:], scale=scale, clip=clip)


def particle_entropy(distances: Tensor, *, scale: float | Tensor = 1.0, clip: float = 0.0) -> Tensor:
    r"""Return :math:`\log(1 + \overline{\mathrm{relu}(d/scale - clip)})`, ``[N]``, averaged over distances ``[N, k]``.

    APT (arXiv 2103.04551) in the form of rll-research/url_benchmark ``utils.py``; ``scale`` is a running mean there.
    """
    return torch.log1p(F.relu(distances / scale - clip).mean(dim=-1))


def info_nce(
    anchors: Tensor,
    positives: Tensor,
    *,
    temperature: float | Tensor = 1.0,
    negatives: Literal["positives", "both"] = "positives",
    reduction: Reduction = "mean",
) -> Tensor:
    """Contrastive cross-entropy in nats; row i of the positives belongs to row i of the anchors, both ``[B, D]``.

    ``negatives="positives"`` compares each anchor with all B positives (ATC), ``"both"`` each of the 2B views, which
    SimCLR normalises beforehand, with the other 2B - 1. ``reduction="none"`` gives ``[B]`` (``"both"``: ``[2B]``).
    """
    count = anchors.shape[0]
    labels = torch.arange(count, device=anchors.device)
    if negatives == "positives":
        logits = anchors @ positives.T / temperature  # (B, D) x (D, B) -> (B, B)
    elif negatives == "both":
        views = torch.cat([anchors, positives])
        logits = (views @ views.T / temperature).masked_fill(_diagonal(2 * count, anchors), float("-inf"))
        labels = torch.cat([labels + count, labels])
    else:
        raise ValueError(f"negatives must be 'positives' or 'both', got {negatives!r}.")
    rows = F.cross_entropy(_at_least_float32(logits), labels, reduction="none")
    return _reduced(rows, reduction)


def becl_loss(
    features: Tensor,
    skills: Tensor,
    *,
    temperature: float | Tensor = 0.5,
    eps: float = 1e-6,
    reduction: Reduction = "mean",
) -> Tensor:
    r"""Behaviour contrastive loss (Rooshy-yang/BeCL ``agent/becl.py``); the reward is ``exp(-loss)`` per row.

    :math:`\ell_i = -\log(pos_i / (\sum_{j\ne i} e^{s_{ij}} + \epsilon) + \epsilon)` of the cosines of features ``[B,
    D]`` over the temperature, less the row's maximum. The positive is the first other row with the same skill
    (``skills`` ``[B]``), or else the first other row, as in the released code. B is at least 2.
    """
    count = features.shape[0]
    if count < 2:
        raise ValueError(f"becl_loss needs at least two rows, got {count}.")
    unit = F.normalize(_at_least_float32(features), dim=-1)
    itself = _diagonal(count, features)
    similarity = (unit @ unit.T / temperature).masked_fill(itself, float("-inf"))
    weights = (similarity - similarity.amax(dim=1, keepdim=True).detach()).exp()  # diagonal: exactly 0
    same_skill = (skills.unsqueeze(0) == skills.unsqueeze(1)) & ~itself
    # argmax of 0/1 (3 for a match) picks the first match, else the first off-diagonal row.
    positive = (same_skill.int() * 2 + (~itself).int()).argmax(dim=1, keepdim=True)
    quotient = weights.gather(1, positive).squeeze(1) / (weights.sum(dim=1) + eps)
    return _reduced(-(quotient + eps).log(), reduction)


@torch.no_grad()
def assignment_entropy(assignments: Tensor) -> Tensor:
    """Mean entropy of assignments ``[B, M]`` in nats, in [0, ln M]; ln M is uniform."""
    return torch.special.entr(assignments).sum(dim=-1).mean()


@torch.no_grad()
def prototypes_in_use(assignments: Tensor) -> Tensor:
    """Number of prototypes with the largest assignment in some row of ``[B, M]``; arbitrary after a collapse."""
    used = assignments.new_zeros(assignments.shape[-1])
    return used.index_fill(0, assignments.argmax(dim=-1), 1.0).sum()


@torch.no_grad()
def mean_pairwise_cosine(unit_rows: Tensor) -> Tensor:
    """Mean cosine over all pairs of different unit rows ``[B, D]``, in O(BD); 0 for a single row."""
    count = unit_rows.shape[0]
    return _off_diagonal_sum(unit_rows) / max(count * (count - 1), 1)


@torch.no_grad()
def prototype_ane(prototypes: Tensor) -> Tensor:
    """Mean negative-pair cosine of unit rows ``[M, D]`` (the paper's ANE): sum over j != k of c_j . c_k, over M^2."""
    return _off_diagonal_sum(prototypes) / prototypes.shape[0] ** 2


@torch.no_grad()
def prototype_kne(prototypes: Tensor, *, k: int = 3) -> Tensor:
    """Mean over unit rows ``[M, D]`` of the cosine to the k-th nearest other one (the paper's KNE); k at most M - 1.

    With k = 3, 512 spread vectors in 128 dimensions give about +0.2; the paper's negative values fit a k near M / 2.
    """
    count = prototypes.shape[0]
    if not 1 <= k < count:
        raise ValueError(f"k must be between 1 and {count - 1} for {count} prototypes, got {k}.")
    cosines = (prototypes @ prototypes.T).masked_fill(_diagonal(count, prototypes), float("-inf"))
    return cosines.topk(k, dim=-1).values[:, -1].mean()


@torch.no_grad()
def prototype_metrics(prototypes: Tensor, *, offset: float = 1.5) -> dict[str, Tensor]:
    """ANE, KNE at k = 3 and k = M / 2, and the dispersion loss, of rows ``[M, D]`` of any length."""
    unit = F.normalize(prototypes, dim=-1)
    return {
        "prototype_ane": prototype_ane(unit),
        "prototype_kne_3": prototype_kne(unit, k=3),
        "prototype_kne_half": prototype_kne(unit, k=prototypes.shape[0] // 2),
        "prototype_dispersion": prototype_dispersion(unit, offset=offset),
    }


def _reduced(rows: Tensor, reduction: Reduction) -> Tensor:
    if reduction not in ("none", "mean", "sum"):
        raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}.")
    if reduction == "none":
        return rows
    if reduction == "sum":
        return rows.sum()
    return rows.sum() / max(rows.numel(), 1)


def _at_least_float32(values: Tensor) -> Tensor:
    return values if values.dtype == torch.float64 else values.float()


def _diagonal(count: int, like: Tensor) -> Tensor:
    return torch.eye(count, dtype=torch.bool, device=like.device)


def _off_diagonal_sum(rows: Tensor) -> Tensor:
    return rows.sum(dim=0).square().sum() - rows.square().sum()

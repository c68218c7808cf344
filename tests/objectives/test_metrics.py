"""Diagnostics against their definitions."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from crptpro.modules import Prototypes
from crptpro.objectives import metrics


def rows(count: int = 9, dim: int = 4) -> torch.Tensor:
    values = torch.randn(count, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return F.normalize(values, dim=1)


def off_diagonal(x: torch.Tensor) -> torch.Tensor:
    return (x @ x.T)[~torch.eye(len(x), dtype=torch.bool)].reshape(len(x), -1)


def test_entropy_is_zero_for_certain_and_log_m_for_uniform_assignments() -> None:
    assert metrics.assignment_entropy(torch.eye(4)).item() == 0
    assert metrics.assignment_entropy(torch.full((3, 8), 1 / 8)).item() == pytest.approx(math.log(8))


def test_prototypes_in_use_counts_distinct_largest_assignments() -> None:
    assignments = torch.tensor([[0.9, 0.1, 0.0], [0.8, 0.1, 0.1], [0.0, 0.1, 0.9]])
    assert metrics.prototypes_in_use(assignments).item() == 2


def test_mean_pairwise_cosine_equals_the_mean_over_all_pairs() -> None:
    assert metrics.mean_pairwise_cosine(rows()).item() == pytest.approx(off_diagonal(rows()).mean().item())
    assert metrics.mean_pairwise_cosine(rows(1).expand(5, 4)).item() == pytest.approx(1.0)
    assert metrics.mean_pairwise_cosine(rows(1)).item() == pytest.approx(0.0, abs=1e-12)


def test_collapsed_float32_embeddings_of_a_full_batch_read_as_one() -> None:
    z = F.normalize(torch.randn(1, 128), dim=1).expand(512, 128)
    assert metrics.mean_pairwise_cosine(z).item() == pytest.approx(1.0, abs=1e-4)


def test_ane_divides_the_off_diagonal_sum_by_m_squared() -> None:
    assert metrics.prototype_ane(rows()).item() == pytest.approx(off_diagonal(rows()).sum().item() / 81)


@pytest.mark.parametrize("k", [1, 3, 8])
def test_kne_is_the_kth_largest_other_cosine(k: int) -> None:
    expected = off_diagonal(rows()).sort(dim=1, descending=True).values[:, k - 1].mean()
    assert metrics.prototype_kne(rows(), k=k).item() == pytest.approx(expected.item())


@pytest.mark.parametrize("k", [0, 9])
def test_impossible_k_is_refused(k: int) -> None:
    with pytest.raises(ValueError, match="between 1 and 8"):
        metrics.prototype_kne(rows(), k=k)


def test_fresh_prototypes_have_the_expected_metrics() -> None:
    torch.manual_seed(0)
    values = metrics.prototype_metrics(3 * Prototypes().weight.detach())
    assert 0.18 < values["prototype_kne_3"] < 0.27
    assert -0.02 < values["prototype_kne_half"] < 0.01
    assert -28.5e-4 < values["prototype_dispersion"] < -22.5e-4
    assert all(value.shape == () for value in values.values())

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from crptpro.analysis.coverage import coverage


def points(count: int = 80, dim: int = 5, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("k", [1, 12, 79])
def test_coverage_is_the_mean_log_of_one_plus_the_mean_neighbour_distance(k: int) -> None:
    z = points()
    total = 0.0
    for i in range(80):
        others = sorted(math.dist(z[i].tolist(), z[j].tolist()) for j in range(80) if j != i)
        total += math.log(1 + sum(others[:k]) / k)
    assert coverage(z, k=k) == pytest.approx(total / 80)


def test_coverage_has_its_known_values_and_bounds() -> None:
    assert coverage(torch.ones(20, 3)) == 0
    corners = torch.tensor([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    assert coverage(corners, k=3) == pytest.approx(math.log(2))
    assert coverage(corners, k=7) == pytest.approx(math.log(1 + (3 + 3 * 2**0.5 + 3**0.5) / 7))
    z = points()
    assert coverage(2 * z) > coverage(z)
    assert coverage(z.flip(0) + 7) == pytest.approx(coverage(z))
    assert 0 < coverage(F.normalize(z, dim=-1)) < math.log(3)
    with pytest.raises(ValueError, match="12 neighbours need more than 12 observations, got 12"):
        coverage(torch.randn(12, 3))

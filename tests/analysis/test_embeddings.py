from __future__ import annotations

import pytest
import torch

from crptpro.analysis.embeddings import principal_components


def test_components_explain_variance_in_decreasing_order_and_reconstruct_the_points() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(40, 5, generator=generator, dtype=torch.float64) * torch.tensor([5.0, 3, 2, 1, 0.1])
    coordinates, explained = principal_components(points, components=5)
    assert (explained.diff() <= 0).all()
    torch.testing.assert_close(explained.sum(), torch.ones((), dtype=torch.float64))
    centred = points - points.mean(0)
    torch.testing.assert_close(coordinates @ coordinates.T, centred @ centred.T)


def test_components_agree_with_the_eigenvectors_of_the_covariance() -> None:
    points = torch.randn(60, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    coordinates, explained = principal_components(points, components=2)
    eigenvalues = torch.linalg.eigvalsh(torch.cov(points.T)).flip(0)
    torch.testing.assert_close(coordinates.var(0), eigenvalues[:2])
    torch.testing.assert_close(explained, eigenvalues[:2] / eigenvalues.sum())


def test_too_many_components_are_refused_with_the_limit_in_the_message() -> None:
    with pytest.raises(ValueError, match=r"at most min.* = 3, got 4"):
        principal_components(torch.randn(3, 10), components=4)

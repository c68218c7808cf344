from __future__ import annotations

import torch

from crptpro.objectives.functional import knn_distances
from crptpro.objectives.particles import merge_moments, particle_entropy

# Golden points: (0,0), (1,0), (0,2), (3,3), three neighbours, the point itself included.
POINTS = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [3.0, 3.0]], dtype=torch.float64)


def start():
    return tuple(torch.tensor(value, dtype=torch.float64) for value in (0.0, 1.0, 1e-4))


def test_the_golden_values_of_the_average_and_of_the_kth_form():
    distances = knn_distances(POINTS, POINTS, k=3)
    average = torch.tensor([0.693147, 0.731738, 0.880466, 1.180482], dtype=torch.float64)
    kth = torch.tensor([1.098612, 1.174359, 1.174359, 1.527262], dtype=torch.float64)
    torch.testing.assert_close(particle_entropy(distances), average, rtol=0, atol=1e-6)
    torch.testing.assert_close(particle_entropy(distances[:, -1:]), kth, rtol=0, atol=1e-6)


def test_division_and_clip_act_on_each_distance_before_the_average():
    distances = torch.tensor([[0.0, 1.0, 4.0]])
    # relu(0 - 1), relu(0.5 - 1), relu(2 - 1): one of three is left.
    torch.testing.assert_close(
        particle_entropy(distances, scale=2.0, clip=1.0), torch.log1p(torch.tensor([1 / 3]))
    )


def test_moments_follow_the_published_update():
    """url_benchmark ``utils.py``, class RMS."""
    mean, variance, count = start()
    m, s, n = 0.0, 1.0, 1e-4
    for seed in range(4):
        values = torch.rand(5 + seed, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        new = values.numel()
        batch_mean = sum(values.flatten().tolist()) / new
        batch_variance = sum((v - batch_mean) ** 2 for v in values.flatten().tolist()) / (new - 1)
        delta = batch_mean - m
        m = m + delta * new / (n + new)
        s = (s * n + batch_variance * new + delta**2 * n * new / (n + new)) / (n + new)
        n = n + new
        mean, variance, count = merge_moments(mean, variance, count, values)
        for got, expected in ((mean, m), (variance, s), (count, n)):
            torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64))


def test_the_mean_is_that_of_all_values_but_for_the_weak_start():
    moments = start()
    values = torch.rand(6, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for batch in values:
        moments = merge_moments(*moments, batch)
    torch.testing.assert_close(moments[0], values.mean(), rtol=1e-6, atol=0)
    torch.testing.assert_close(moments[1], values.var(), rtol=0.02, atol=0)


def test_moments_are_kept_in_their_own_precision():
    moments = merge_moments(*start(), torch.rand(4, 4))
    assert all(moment.dtype == torch.float64 for moment in moments)

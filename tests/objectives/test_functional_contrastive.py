"""Nearest neighbours and contrastive losses: golden values and the published formulas typed again."""

from __future__ import annotations

import math

import pytest
import torch
from tensor_checks import close, double, unit

from crptpro.objectives.functional import becl_loss, info_nce, knn_distance, knn_distances, particle_reward

# Nearest neighbours --------------------------------------------------------------------------------------------


def test_knn_reward_golden_values() -> None:
    queries, queue = double([[1, 0], [0.6, 0.8]]), double([[1, 0], [0, 1], [0.8, 0.6], [-1, 0]])
    close(knn_distance(queries, queue, k=3), double([1.414214, 0.894427]))


def test_knn_equals_the_broadcast_difference() -> None:
    queries, keys = unit(30, 16).float(), unit(200, 16, seed=1).float()
    expected = (queries[:, None] - keys[None]).norm(dim=-1).sort(dim=1).values[:, :5]
    close(knn_distances(queries, keys, k=5), expected, 1e-6)
    assert torch.equal(knn_distance(queries, keys, k=5), knn_distances(queries, keys, k=5)[:, -1])


def test_k_copies_of_a_query_are_at_exactly_zero() -> None:
    queries = unit(40, 128).float()
    keys = torch.cat([unit(100, 128, seed=1).float(), queries.repeat(3, 1)])
    assert not knn_distances(queries, keys, k=3).any()
    assert (knn_distance(queries, keys, k=4) > 0.1).all()


def test_unfilled_queue_rows_are_at_distance_one() -> None:
    close(knn_distance(unit(4, 8), torch.zeros(5, 8, dtype=torch.float64), k=3), torch.ones(4).double())


@pytest.mark.parametrize("k", [0, 5])
def test_impossible_k_is_refused(k: int) -> None:
    with pytest.raises(ValueError, match=rf"4, got {k}"):
        knn_distance(torch.zeros(2, 3), torch.zeros(4, 3), k=k)


def test_particle_reward_golden_values() -> None:
    points = double([[0, 0], [1, 0], [0, 2], [3, 3]])
    close(particle_reward(points, k=3), double([0.693147, 0.731738, 0.880466, 1.180482]))
    close(particle_reward(points, k=3, average=False), double([1.098612, 1.174359, 1.174359, 1.527262]))


def test_particle_reward_scales_and_clips_each_distance_before_averaging() -> None:
    points = double([[0.0], [1.0], [10.0]])
    # Row 0: distances 0, 1, 10 -> /2 - 1 -> relu: 0, 0, 4.
    assert particle_reward(points, k=3, scale=2.0, clip=1.0)[0].item() == pytest.approx(math.log(1 + 4 / 3))
    close(particle_reward(points[:1], k=1, keys=points[1:]), double([math.log(2)]))


# Contrastive losses ----------------------------------------------------------------------------------------------


def test_atc_golden_values() -> None:
    anchors, positives = double([[1, 2], [0, 1], [2, 0]]), double([[1, 1], [0, 2], [1, 0]])
    rows = info_nce(anchors, positives, reduction="none")
    close(rows, double([1.349012, 0.407606, 0.758624]))
    assert info_nce(anchors, positives).item() == pytest.approx(0.838414, abs=1e-6)


def test_simclr_golden_value() -> None:
    views = double([[1, 0], [0, 1], [0.8, 0.6], [-0.6, 0.8]])
    loss = info_nce(views[:2], views[2:], temperature=0.07, negatives="both")
    assert loss.item() == pytest.approx(0.027933, abs=1e-6)


def test_simclr_equals_the_published_sum_over_2b_views() -> None:
    first, second = unit(5, 4), unit(5, 4, seed=1)
    views = torch.cat([first, second])
    expected = []
    for i in range(10):
        similarities = [math.exp(float(views[i] @ views[j]) / 0.5) for j in range(10)]
        positive = similarities[(i + 5) % 10]
        expected.append(-math.log(positive / (sum(similarities) - similarities[i])))
    close(
        info_nce(first, second, temperature=0.5, negatives="both", reduction="none"), double(expected), 1e-9
    )


@pytest.mark.parametrize("negatives", ["positives", "both"])
def test_invalid_rows_are_ignored_but_stay_negatives(negatives) -> None:
    anchors, positives = unit(4, 3), unit(4, 3, seed=1)
    valid = torch.tensor([True, False, True, True])
    both = valid if negatives == "positives" else torch.cat([valid, valid])
    rows = info_nce(anchors, positives, negatives=negatives, reduction="none")
    masked = info_nce(anchors, positives, negatives=negatives, valid=valid, reduction="none")
    close(masked, rows * both)
    loss = info_nce(anchors, positives, negatives=negatives, valid=valid)
    close(loss, rows[both].mean())
    nothing = info_nce(anchors, positives, negatives=negatives, valid=torch.zeros(4, dtype=torch.bool))
    assert nothing.item() == 0
    with pytest.raises(ValueError, match="'all'"):
        info_nce(anchors, positives, negatives="all")  # type: ignore[arg-type]


def test_what_an_invalid_anchor_holds_reaches_neither_the_loss_nor_the_gradient() -> None:
    anchors, positives = unit(4, 3), unit(4, 3, seed=1)
    valid = torch.tensor([True, False, True, True])
    expected = info_nce(anchors, positives, valid=valid)
    anchors[1] = torch.nan
    anchors.requires_grad_()
    positives.requires_grad_()
    loss = info_nce(anchors, positives, valid=valid)
    loss.backward()
    close(loss, expected)
    assert not anchors.grad[1].any()
    assert anchors.grad.isfinite().all()
    assert positives.grad.isfinite().all()


def test_info_nce_of_one_pair_is_zero() -> None:
    assert info_nce(unit(1, 3), unit(1, 3, seed=1)).item() == 0
    assert info_nce(unit(1, 3), unit(1, 3, seed=1), negatives="both").item() == 0


def test_becl_golden_losses_and_rewards() -> None:
    features, skills = double([[1, 0], [0.6, 0.8], [0, 1], [-1, 0]]), torch.tensor([0, 0, 1, 1])
    rows = becl_loss(features, skills, temperature=0.5, reduction="none")
    close(rows, double([0.294128, 0.948772, 1.939172, 0.362229]))
    close((-rows).exp(), double([0.745181, 0.387216, 0.143823, 0.696123]))
    close(becl_loss(3 * features, skills, temperature=0.5), rows.mean())


def test_becl_equals_the_released_arithmetic_with_lonely_skills() -> None:
    features, skills = unit(7, 5), torch.tensor([0, 1, 2, 1, 0, 3, 1])
    expected = []
    for i in range(7):
        others = [j for j in range(7) if j != i]
        similarity = torch.stack([features[i] @ features[j] for j in others]) / 0.5
        weights = (similarity - similarity.max()).exp()
        match = next((n for n, j in enumerate(others) if skills[j] == skills[i]), 0)
        expected.append(-math.log(float(weights[match] / (weights.sum() + 1e-6)) + 1e-6))
    close(becl_loss(features, skills, reduction="none"), double(expected), 1e-9)


def test_becl_of_one_row_is_refused() -> None:
    with pytest.raises(ValueError, match="at least two rows, got 1"):
        becl_loss(torch.ones(1, 3), torch.zeros(1))

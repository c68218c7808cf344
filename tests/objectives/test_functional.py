"""The mathematics: golden values, published formulas typed again, closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from loss_cases import close, double, released_sinkhorn, unit
from torch import Tensor

from crptpro.modules import Prototypes
from crptpro.objectives import functional
from crptpro.objectives.functional import (
    becl_loss,
    comparative_loss,
    info_nce,
    knn_distance,
    knn_distances,
    particle_reward,
    prototype_ane,
    prototype_dispersion,
    sinkhorn_knopp,
)

SCORES = double([[0.9, 0.1, -0.3], [0.2, 0.8, 0.0], [-0.5, 0.4, 0.7], [0.6, 0.5, 0.1]])
PROTOTYPES = double([[1, 0, 0], [0.6, 0.8, 0], [0, 0, -1], [-0.8, 0.6, 0]])


def test_sinkhorn_and_comparative_loss_golden_values() -> None:
    expected = [
        [0.999007, 0.000891, 0.000101],
        [0.000929, 0.996992, 0.002079],
        [0.000000, 0.007945, 0.992054],
        [0.478508, 0.468186, 0.053306],
    ]
    assignments = sinkhorn_knopp(SCORES, temperature=0.1, iterations=3)
    close(assignments, double(expected))
    assert comparative_loss(SCORES, assignments, temperature=0.1).item() == pytest.approx(0.289759, abs=1e-6)


@pytest.mark.parametrize(("samples", "prototypes"), [(64, 32), (7, 20), (1, 5)])
@pytest.mark.parametrize("temperature", [0.05, 0.1])
def test_sinkhorn_equals_the_released_arithmetic(samples: int, prototypes: int, temperature: float) -> None:
    scores = unit(samples, 8) @ unit(prototypes, 8, seed=1).T
    expected = released_sinkhorn(scores, temperature)
    close(sinkhorn_knopp(scores, temperature=temperature), expected, 1e-12)
    close(sinkhorn_knopp(scores.float(), temperature=temperature), expected.float(), 1e-5)


def test_sinkhorn_spreads_the_mass_evenly_as_iterations_grow() -> None:
    scores = unit(40, 6) @ unit(10, 6, seed=1).T
    unevenness = []
    for iterations in (0, 3, 300):
        assignments = sinkhorn_knopp(scores, iterations=iterations)
        close(assignments.sum(dim=1), torch.ones(40, dtype=torch.float64), 1e-12)
        unevenness.append((assignments.mean(dim=0) - 0.1).abs().max().item())
    assert unevenness[2] < 1e-6 < unevenness[1] < unevenness[0]
    close(sinkhorn_knopp(scores, iterations=0), (scores / 0.1).softmax(dim=1), 1e-12)
    identical = unit(1, 8).expand(6, 8) @ unit(4, 8).T
    close(sinkhorn_knopp(identical), torch.full((6, 4), 0.25, dtype=torch.float64))


def test_sinkhorn_survives_underflow_has_no_gradient_stays_in_float32_and_passes_nan_on() -> None:
    scores = torch.tensor([[1.0, 0.9], [-1.0, -0.9]], requires_grad=True)
    assignments = sinkhorn_knopp(scores, temperature=1e-3)
    assert assignments.isfinite().all()
    assert not assignments.requires_grad
    assert sinkhorn_knopp(SCORES.to(torch.bfloat16)).dtype == torch.float32
    assert sinkhorn_knopp(torch.tensor([[0.1, float("nan")], [0.2, 0.3]])).isnan().any()


def test_comparative_loss_of_uniform_predictions_is_log_m() -> None:
    for count, expected in ((2, math.log(2)), (512, 6.2383)):
        uniform = torch.full((3, count), 1 / count)
        assert comparative_loss(torch.zeros(3, count), uniform).item() == pytest.approx(expected, abs=1e-4)


def test_dispersion_golden_values_and_gradient() -> None:
    prototypes = PROTOTYPES.clone().requires_grad_()
    loss = prototype_dispersion(prototypes, offset=1.5, reduction="mean_all")
    loss.backward()
    assert loss.item() == pytest.approx(-0.107143, abs=1e-6)
    assert prototype_ane(PROTOTYPES).item() == pytest.approx(-0.025, abs=1e-9)
    expected = [
        [-0.053571, 0.077381, -0.041667],
        [-0.003571, 0.025, -0.041667],
        [0.033333, 0.058333, 0],
        [0.114286, 0.033333, -0.041667],
    ]
    close(prototypes.grad, double(expected))


def test_dispersion_reductions_differ_by_their_divisors() -> None:
    total = prototype_dispersion(PROTOTYPES, reduction="sum")
    assert total.item() == pytest.approx(-1.714286, abs=1e-6)
    close(prototype_dispersion(PROTOTYPES, reduction="mean_all"), total / 16, 1e-12)
    close(prototype_dispersion(PROTOTYPES, reduction="mean_offdiag"), total / 12, 1e-12)
    with pytest.raises(ValueError, match="mean_all"):
        prototype_dispersion(PROTOTYPES, reduction="mean")  # type: ignore[arg-type]


def test_dispersion_is_zero_for_orthogonal_or_single_prototypes_and_ignores_rotation() -> None:
    assert prototype_dispersion(torch.eye(5)).item() == 0
    assert prototype_dispersion(unit(1, 4), reduction="mean_offdiag").item() == 0
    rotation, _ = torch.linalg.qr(torch.randn(6, 6).double())
    close(prototype_dispersion(unit(9, 6) @ rotation), prototype_dispersion(unit(9, 6)), 1e-12)


def test_knn_equals_the_golden_values_and_the_broadcast_difference() -> None:
    queries, queue = double([[1, 0], [0.6, 0.8]]), double([[1, 0], [0, 1], [0.8, 0.6], [-1, 0]])
    close(knn_distance(queries, queue, k=3), double([1.414214, 0.894427]))
    queries, keys = unit(30, 16).float(), unit(200, 16, seed=1).float()
    expected = (queries[:, None] - keys[None]).norm(dim=-1).sort(dim=1).values[:, :5]
    close(knn_distances(queries, keys, k=5), expected, 1e-6)
    assert torch.equal(knn_distance(queries, keys, k=5), knn_distances(queries, keys, k=5)[:, -1])


@pytest.mark.parametrize("k", [0, 5])
def test_impossible_k_is_refused(k: int) -> None:
    with pytest.raises(ValueError, match=rf"4, got {k}"):
        knn_distance(torch.zeros(2, 3), torch.zeros(4, 3), k=k)
    with pytest.raises(ValueError, match="between 1 and 4"):
        functional.prototype_kne(torch.zeros(5, 3), k=k)


def test_particle_reward_golden_values_scaled_and_clipped_before_averaging() -> None:
    points = double([[0, 0], [1, 0], [0, 2], [3, 3]])
    close(particle_reward(points, k=3), double([0.693147, 0.731738, 0.880466, 1.180482]))
    close(particle_reward(points, k=3, average=False), double([1.098612, 1.174359, 1.174359, 1.527262]))
    points = double([[0.0], [1.0], [10.0]])
    # Row 0: distances 0, 1, 10 -> /2 - 1 -> relu: 0, 0, 4.
    assert particle_reward(points, k=3, scale=2.0, clip=1.0)[0].item() == pytest.approx(math.log(1 + 4 / 3))
    close(particle_reward(points[:1], k=1, keys=points[1:]), double([math.log(2)]))


def test_atc_golden_values() -> None:
    anchors, positives = double([[1, 2], [0, 1], [2, 0]]), double([[1, 1], [0, 2], [1, 0]])
    close(info_nce(anchors, positives, reduction="none"), double([1.349012, 0.407606, 0.758624]))
    assert info_nce(anchors, positives).item() == pytest.approx(0.838414, abs=1e-6)
    assert info_nce(anchors, positives, reduction="sum").item() == pytest.approx(3 * 0.838414, abs=3e-6)
    for wrong in ({"negatives": "all"}, {"reduction": "median"}):
        with pytest.raises(ValueError, match=r"got '(all|median)'"):
            info_nce(anchors, positives, **wrong)  # type: ignore[arg-type]


def test_becl_golden_losses_and_rewards() -> None:
    features, skills = double([[1, 0], [0.6, 0.8], [0, 1], [-1, 0]]), torch.tensor([0, 0, 1, 1])
    rows = becl_loss(features, skills, temperature=0.5, reduction="none")
    close(rows, double([0.294128, 0.948772, 1.939172, 0.362229]))
    close((-rows).exp(), double([0.745181, 0.387216, 0.143823, 0.696123]))
    close(becl_loss(3 * features, skills, temperature=0.5), rows.mean())
    with pytest.raises(ValueError, match="at least two rows, got 1"):
        becl_loss(features[:1], skills[:1])


def off_diagonal(x: Tensor) -> Tensor:
    return (x @ x.T)[~torch.eye(len(x), dtype=torch.bool)].reshape(len(x), -1)


def test_entropy_and_use_of_assignments() -> None:
    assert functional.assignment_entropy(torch.eye(4)).item() == 0
    assert functional.assignment_entropy(torch.full((3, 8), 1 / 8)).item() == pytest.approx(math.log(8))
    assignments = torch.tensor([[0.9, 0.1, 0.0], [0.8, 0.1, 0.1], [0.0, 0.1, 0.9]])
    assert functional.prototypes_in_use(assignments).item() == 2


def test_cosine_diagnostics_equal_what_all_pairs_give() -> None:
    rows, cosines = unit(9, 4), off_diagonal(unit(9, 4))
    assert functional.mean_pairwise_cosine(rows).item() == pytest.approx(cosines.mean().item())
    assert functional.mean_pairwise_cosine(unit(1, 4).expand(5, 4)).item() == pytest.approx(1.0)
    assert functional.mean_pairwise_cosine(unit(1, 4)).item() == pytest.approx(0.0, abs=1e-12)
    assert functional.prototype_ane(rows).item() == pytest.approx(cosines.sum().item() / 81)
    for k in (1, 3, 8):
        expected = cosines.sort(dim=1, descending=True).values[:, k - 1].mean().item()
        assert functional.prototype_kne(rows, k=k).item() == pytest.approx(expected)


def test_fresh_prototypes_have_the_expected_metrics() -> None:
    torch.manual_seed(0)
    values = functional.prototype_metrics(3 * Prototypes().weight.detach())
    assert 0.18 < values["prototype_kne_3"] < 0.27
    assert -0.02 < values["prototype_kne_half"] < 0.01
    assert -28.5e-4 < values["prototype_dispersion"] < -22.5e-4
    assert all(value.shape == () for value in values.values())

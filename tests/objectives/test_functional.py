"""Sinkhorn, comparative loss and dispersion: golden values, published formulas typed again, closed forms."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from tensor_checks import close, double, unit
from torch import Tensor

from crptpro.objectives.functional import comparative_loss, prototype_dispersion, sinkhorn_knopp
from crptpro.objectives.metrics import prototype_ane

SCORES = double([[0.9, 0.1, -0.3], [0.2, 0.8, 0.0], [-0.5, 0.4, 0.7], [0.6, 0.5, 0.1]])
PROTOTYPES = double([[1, 0, 0], [0.6, 0.8, 0], [0, 0, -1], [-0.8, 0.6, 0]])


# Sinkhorn and the comparative loss -------------------------------------------------------------------------


def released_sinkhorn(scores: Tensor, temperature: float, iterations: int = 3) -> Tensor:
    """The released code's arithmetic (denisyarats/proto, proto.py): exponentiated, on the transpose."""
    scaled = scores / temperature
    q = torch.exp(scaled - scaled.max()).T
    q = q / q.sum()
    rows, columns = torch.ones(q.shape[0]) / q.shape[0], torch.ones(q.shape[1]) / q.shape[1]
    for _ in range(iterations):
        q = q * (rows / q.sum(dim=1)).unsqueeze(1)
        q = q * (columns / q.sum(dim=0)).unsqueeze(0)
    return (q / q.sum(dim=0, keepdim=True)).T


def test_sinkhorn_golden_values() -> None:
    expected = [
        [0.999007, 0.000891, 0.000101],
        [0.000929, 0.996992, 0.002079],
        [0.000000, 0.007945, 0.992054],
        [0.478508, 0.468186, 0.053306],
    ]
    close(sinkhorn_knopp(SCORES, temperature=0.1, iterations=3), double(expected))


def test_comparative_loss_golden_value() -> None:
    loss = comparative_loss(SCORES, sinkhorn_knopp(SCORES), temperature=0.1)
    assert loss.item() == pytest.approx(0.289759, abs=1e-6)


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


def test_sinkhorn_of_identical_samples_is_uniform() -> None:
    close(
        sinkhorn_knopp(unit(1, 8).expand(6, 8) @ unit(4, 8).T), torch.full((6, 4), 0.25, dtype=torch.float64)
    )


def test_sinkhorn_commutes_with_permuting_the_batch() -> None:
    order = torch.randperm(9)
    scores = unit(9, 4) @ unit(5, 4, seed=1).T
    close(sinkhorn_knopp(scores[order]), sinkhorn_knopp(scores)[order], 1e-12)


def test_sinkhorn_survives_rows_that_underflow_and_has_no_gradient() -> None:
    scores = torch.tensor([[1.0, 0.9], [-1.0, -0.9]], requires_grad=True)
    assignments = sinkhorn_knopp(scores, temperature=1e-3)
    assert assignments.isfinite().all()
    assert not assignments.requires_grad


def test_sinkhorn_stays_in_float32_for_half_precision_scores_and_passes_nan_on() -> None:
    assert sinkhorn_knopp(SCORES.to(torch.bfloat16)).dtype == torch.float32
    assert sinkhorn_knopp(torch.tensor([[0.1, float("nan")], [0.2, 0.3]])).isnan().any()


@pytest.mark.parametrize("count", [2, 512])
def test_comparative_loss_of_uniform_predictions_is_log_m(count: int) -> None:
    uniform = torch.full((3, count), 1 / count)
    assert comparative_loss(torch.zeros(3, count), uniform).item() == pytest.approx(math.log(count), abs=1e-5)
    if count == 512:
        assert math.log(count) == pytest.approx(6.238, abs=1e-3)


def test_comparative_loss_equals_the_published_double_sum() -> None:
    scores, q = unit(5, 4) @ unit(6, 4, seed=1).T, torch.rand(5, 6).double().softmax(dim=1)
    expected = 0.0
    for i in range(5):
        denominator = sum(math.exp(scores[i, k] / 0.2) for k in range(6))
        expected -= sum(q[i, j] * math.log(math.exp(scores[i, j] / 0.2) / denominator) for j in range(6)) / 5
    assert comparative_loss(scores, q, temperature=0.2).item() == pytest.approx(float(expected))


def test_comparative_loss_of_one_prototype_is_zero() -> None:
    assert comparative_loss(torch.rand(3, 1), torch.ones(3, 1)).item() == 0


# Dispersion --------------------------------------------------------------------------------------------------


def released_dispersion(raw: Tensor) -> Tensor:
    """The released code's loop: left factor and denominator detached, diagonal zeroed entry by entry."""
    cosines = raw.detach() @ raw.T
    ratio = cosines / (cosines.detach() + 1.5)
    for i in range(raw.shape[0]):
        ratio[i, i] = 0
    return ratio.mean()


def test_dispersion_golden_values_and_gradient() -> None:
    prototypes = PROTOTYPES.clone().requires_grad_()
    loss = prototype_dispersion(prototypes, offset=1.5, reduction="mean_all")
    loss.backward()
    assert loss.item() == pytest.approx(-0.107143, abs=1e-6)
    assert prototype_dispersion(PROTOTYPES, reduction="sum").item() == pytest.approx(-1.714286, abs=1e-6)
    assert prototype_ane(PROTOTYPES).item() == pytest.approx(-0.025, abs=1e-9)
    expected = [
        [-0.053571, 0.077381, -0.041667],
        [-0.003571, 0.025, -0.041667],
        [0.033333, 0.058333, 0],
        [0.114286, 0.033333, -0.041667],
    ]
    close(prototypes.grad, double(expected))


def test_dispersion_equals_the_released_loop_in_value_and_gradient() -> None:
    mine, theirs = unit(20, 6).requires_grad_(), unit(20, 6).requires_grad_()
    loss, expected = prototype_dispersion(mine), released_dispersion(theirs)
    close(loss, expected, 1e-12)
    loss.backward()
    expected.backward()
    close(mine.grad, theirs.grad, 1e-12)


def test_dispersion_reductions_differ_by_their_divisors() -> None:
    prototypes = unit(7, 4)
    total = prototype_dispersion(prototypes, reduction="sum")
    close(prototype_dispersion(prototypes, reduction="mean_all"), total / 49, 1e-12)
    close(prototype_dispersion(prototypes, reduction="mean_offdiag"), total / 42, 1e-12)
    with pytest.raises(ValueError, match="mean_all"):
        prototype_dispersion(prototypes, reduction="mean")  # type: ignore[arg-type]


def test_dispersion_is_zero_for_orthogonal_or_single_prototypes_and_ignores_rotation() -> None:
    assert prototype_dispersion(torch.eye(5)).item() == 0
    assert prototype_dispersion(unit(1, 4), reduction="mean_offdiag").item() == 0
    rotation, _ = torch.linalg.qr(torch.randn(6, 6).double())
    close(prototype_dispersion(unit(9, 6) @ rotation), prototype_dispersion(unit(9, 6)), 1e-12)


def test_descending_the_dispersion_spreads_prototypes() -> None:
    prototypes = F.normalize(unit(8, 3) + 2.0, dim=1).requires_grad_()
    before = prototype_ane(prototypes)
    for _ in range(50):
        (gradient,) = torch.autograd.grad(prototype_dispersion(prototypes), prototypes)
        prototypes = F.normalize(prototypes.detach() - gradient, dim=1).requires_grad_()
    assert prototype_ane(prototypes) < before - 0.3


def test_unknown_reduction_is_refused() -> None:
    with pytest.raises(ValueError, match="'median'"):
        comparative_loss(SCORES, SCORES, reduction="median")  # type: ignore[arg-type]

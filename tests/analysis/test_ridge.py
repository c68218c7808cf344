from __future__ import annotations

import pytest
import torch

from crptpro.analysis.ridge import PENALTIES, effective_rank, fit_ridge, mean_cosine, standardized_gram
from crptpro.objectives.metrics import mean_pairwise_cosine

ROWS = torch.arange(240)
TRAIN, VALIDATION, TEST = ROWS[:120], ROWS[120:160], ROWS[160:]
FITTED = ROWS[:160]


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def r2(features: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    return fit_ridge(standardized_gram(features, FITTED), targets, TRAIN, VALIDATION, TEST).r2


def test_what_is_linear_in_the_features_is_predicted_fully() -> None:
    features = 3 + torch.randn(240, 20) * torch.logspace(-1, 1, 20)
    targets = 5 + features @ torch.randn(20, 3)
    assert (r2(features, targets) > 0.9999).all()


def test_noise_is_not_predicted_from_more_features_than_samples() -> None:
    scores = r2(torch.randn(240, 1_000), torch.randn(240, 8))
    assert (scores < 0.05).all()
    assert scores.mean() > -0.3


def test_memorising_the_training_samples_earns_nothing() -> None:
    """Each sample has a feature of its own: any target is fitted exactly, none is predicted."""
    assert (r2(torch.eye(240), torch.randn(240, 4)) < 0.05).all()


def test_a_penalty_is_chosen_for_each_target_by_what_was_not_fitted() -> None:
    features = torch.randn(240, 400)
    clean = features @ torch.randn(400, 1) / 20
    targets = torch.cat([clean, clean + 3 * torch.randn(240, 1)], 1)
    fit = fit_ridge(standardized_gram(features, FITTED), targets, TRAIN, VALIDATION, TEST)
    assert set(fit.penalty.tolist()) <= set(PENALTIES)
    assert fit.penalty[0] < fit.penalty[1]
    assert fit.r2[0] > 0.2 > fit.r2[1]


@pytest.mark.parametrize("train", [FITTED, torch.isin(ROWS, FITTED)])
def test_inner_products_are_those_of_standardised_features(train: torch.Tensor) -> None:
    features = 2 + torch.randn(240, 5_000).double() * torch.logspace(-1, 1, 5_000).double()
    before = features.clone()
    deviation = features[FITTED].std(0, correction=0)
    scale = deviation + deviation.square().mean().sqrt()
    x = (features - features[FITTED].mean(0)) / scale
    gram = standardized_gram(features, train)
    torch.testing.assert_close(gram, x @ x.T)
    assert gram.equal(gram.T)
    assert features.equal(before)
    torch.testing.assert_close(standardized_gram(features.float(), train), x @ x.T, rtol=1e-5, atol=1e-3)


def test_the_mean_cosine_is_that_of_all_pairs() -> None:
    features = 0.3 + torch.randn(240, 5_000)
    features[7] = 0
    unit = torch.nn.functional.normalize(features.double(), dim=-1)
    assert mean_cosine(features) == pytest.approx(float(mean_pairwise_cosine(unit)), abs=1e-9)
    assert mean_cosine(features[:1]) == 0
    assert mean_cosine(torch.ones(3, 2)) == pytest.approx(1, abs=1e-12)
    before = unit.clone()
    mean_cosine(unit)
    effective_rank(unit)
    assert unit.equal(before)


def test_the_dual_form_is_ridge_regression() -> None:
    features, targets = torch.randn(240, 6).double(), torch.randn(240, 1).double()
    targets += features[:, :1]
    fit = fit_ridge(features @ features.T, targets, TRAIN, VALIDATION, TEST)
    x, y = features[FITTED] - features[FITTED].mean(0), targets[FITTED] - targets[FITTED].mean(0)
    scale = torch.linalg.eigvalsh(x @ x.T).clamp(min=0).mean()
    weights = torch.linalg.solve(x.T @ x + fit.penalty * scale * torch.eye(6), x.T @ y)
    predicted = (features[TEST] - features[FITTED].mean(0)) @ weights + targets[FITTED].mean(0)
    residual, truth = predicted - targets[TEST], targets[TEST] - targets[TEST].mean(0)
    torch.testing.assert_close(fit.r2, 1 - residual.square().sum(0) / truth.square().sum(0))


def test_held_out_samples_do_not_take_part_in_standardising() -> None:
    features = torch.randn(240, 10)
    changed = features.clone()
    changed[TEST] *= 100
    first, second = (standardized_gram(each, FITTED) for each in (features, changed))
    torch.testing.assert_close(first[FITTED][:, FITTED], second[FITTED][:, FITTED])


def test_a_feature_that_marks_single_samples_does_not_drown_the_others() -> None:
    """ReLU features that are active in one sample of hundreds, by the hundreds."""
    rare = torch.zeros(240, 5_000)
    rare[torch.randint(0, 240, (5_000,)), torch.arange(5_000)] = 0.01
    features = torch.cat([torch.randn(240, 5), rare], 1)
    assert r2(features, features[:, :1] + 0.0).item() > 0.98


def test_features_that_never_change_predict_the_mean() -> None:
    scores = r2(torch.ones(240, 7), torch.randn(240, 2))
    assert ((scores <= 0) & (scores > -0.3)).all()


def test_effective_rank_counts_directions() -> None:
    signs = torch.tensor([1.0, -1.0])
    axes = torch.cat([torch.eye(5) * sign for sign in signs])
    assert effective_rank(axes) == pytest.approx(5)
    assert effective_rank(axes + 100) == pytest.approx(5, rel=1e-4)  # of centred samples
    assert effective_rank(torch.arange(6.0)[:, None] * torch.ones(1, 9)) == pytest.approx(1)
    assert effective_rank(torch.ones(4, 3)) == 0
    wide = torch.randn(8, 9_000)  # more than one block
    singular = torch.linalg.svdvals((wide - wide.mean(0)).double())[:7]
    entropy = torch.special.entr(singular / singular.sum()).sum()
    assert effective_rank(wide) == pytest.approx(entropy.exp().item(), rel=1e-6)

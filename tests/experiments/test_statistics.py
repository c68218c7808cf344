from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from crptpro.experiments.statistics import (
    evaluation_means,
    expert_normalized,
    final_score,
    iqm,
    last_evaluations_score,
    mean,
    median,
    optimality_gap,
    performance_profile,
    probability_of_improvement,
)

AGGREGATES = [iqm, mean, median, optimality_gap]


def tasks(*counts: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(0.8, 0.4, count) for count in counts]


# --- one run ----------------------------------------------------------------------------------------------------


def test_a_final_score_is_the_mean_of_the_last_evaluation_whatever_the_order_of_rows() -> None:
    steps, returns = [1000, 0, 1000, 500], [10.0, 99.0, 20.0, 77.0]
    assert final_score(steps, returns) == 15.0
    places, means = evaluation_means(steps, returns)
    assert places.tolist() == [0, 500, 1000]
    assert means.tolist() == [99.0, 77.0, 15.0]


def test_the_last_evaluations_count_the_same_whatever_their_number_of_episodes() -> None:
    steps, returns = [0, 1, 2, 2, 2], [1000.0, 4.0, 7.0, 8.0, 9.0]
    assert last_evaluations_score(steps, returns, evaluations=2) == 6.0
    assert last_evaluations_score(steps, returns, evaluations=10) == pytest.approx(1012 / 3)


@pytest.mark.parametrize(
    ("steps", "returns", "message"),
    [
        ([0, 1], [1.0, float("nan")], r"episode_returns\[1\] is nan"),
        ([0, 1], [float("inf"), 1.0], r"episode_returns\[0\] is inf"),
        ([], [], "one at least"),
        ([0], [1.0, 2.0], "as many env steps"),
    ],
)
def test_a_run_without_a_score_is_refused_by_name(steps: list, returns: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        final_score(steps, returns)


def test_normalizing_divides_by_the_experts_score_and_names_a_task_without_one() -> None:
    scores = {"walker_run": [485.0, 970.0], "hopper_hop": [0.0]}
    normalized = expert_normalized(scores, {"walker_run": 485, "hopper_hop": 283, "finger_spin": 938})
    assert normalized["walker_run"].tolist() == [1.0, 2.0]
    assert normalized["hopper_hop"].tolist() == [0.0]
    with pytest.raises(ValueError, match="no expert's score on hopper_hop"):
        expert_normalized(scores, {"walker_run": 485})
    with pytest.raises(ValueError, match="got 0 on hopper_hop"):
        expert_normalized(scores, {"walker_run": 485, "hopper_hop": 0})


# --- many runs: closed forms ------------------------------------------------------------------------------------


def test_aggregates_of_known_numbers() -> None:
    scores = [np.array([0.0, 1.0]), np.array([0.2, 0.4]), np.array([1.0, 5.0])]
    assert mean(scores) == pytest.approx((0.5 + 0.3 + 3.0) / 3)
    assert median(scores) == pytest.approx(0.5)
    assert iqm(scores) == pytest.approx((0.2 + 0.4 + 1.0 + 1.0) / 4)
    assert optimality_gap(scores) == pytest.approx((1.0 + 0.8 + 0.6) / 6)
    assert optimality_gap(scores, target=5.0) == pytest.approx(5 - mean(scores))


@pytest.mark.parametrize("aggregate", AGGREGATES)
def test_a_single_run_is_its_own_aggregate(aggregate) -> None:
    assert aggregate([np.array([0.25])]) == pytest.approx(0.75 if aggregate is optimality_gap else 0.25)


@pytest.mark.parametrize("runs", range(1, 10))
@pytest.mark.parametrize("number", [1, 2, 3, 12])
def test_the_interquartile_mean_is_scipys_trimmed_mean(number: int, runs: int) -> None:
    scores = tasks(*[runs] * number)
    assert iqm(scores) == pytest.approx(trim_mean(np.concatenate(scores), 0.25))


@pytest.mark.parametrize("aggregate", AGGREGATES)
@pytest.mark.parametrize("counts", [(4, 4), (4, 8), (2, 4, 16)])
def test_a_task_whose_runs_are_all_there_twice_counts_no_more(aggregate, counts: tuple[int, ...]) -> None:
    scores = tasks(4, 4, 4)[: len(counts)]
    repeated = [np.repeat(s, 16) for s in scores]
    unequal = [np.repeat(s, count) for s, count in zip(scores, counts)]
    assert aggregate(unequal) == pytest.approx(aggregate(repeated), abs=1e-12)


def test_the_interquartile_mean_of_unequal_counts_ignores_outliers_at_both_ends() -> None:
    calm = [np.full(7, 0.5), np.full(3, 0.5)]
    wild = [np.array([-1e6, *[0.5] * 5, 1e6]), np.full(3, 0.5)]
    assert iqm(wild) == pytest.approx(iqm(calm))


@pytest.mark.parametrize("aggregate", AGGREGATES)
@pytest.mark.parametrize("counts", [(3, 3), (2, 5)])
def test_leading_axes_are_many_samples_at_once(aggregate, counts: tuple[int, ...]) -> None:
    many = [np.random.default_rng(i).normal(size=(4, 6, count)) for i, count in enumerate(counts)]
    together = aggregate(many)
    assert together.shape == (4, 6)
    one_by_one = [[aggregate([m[i, j] for m in many]) for j in range(6)] for i in range(4)]
    np.testing.assert_allclose(together, one_by_one)


@pytest.mark.parametrize("aggregate", [iqm, mean, median])
def test_aggregates_move_and_scale_with_the_scores(aggregate) -> None:
    scores = tasks(3, 5, 4)
    assert aggregate([2 * s + 3 for s in scores]) == pytest.approx(2 * aggregate(scores) + 3)


def test_a_profile_counts_runs_above_each_threshold() -> None:
    scores = [np.array([0.0, 0.5, 0.5, 1.0]), np.array([2.0])]
    profile = performance_profile(scores, [-1.0, 0.0, 0.5, 1.0, 2.0])
    np.testing.assert_allclose(profile, [1.0, (0.75 + 1) / 2, (0.25 + 1) / 2, 0.5, 0.0])


def test_the_area_under_a_profile_is_the_mean() -> None:
    scores = [s.clip(0, 2) for s in tasks(3, 5)]
    thresholds = np.linspace(0, 2, 20_001)
    area = performance_profile(scores, thresholds).mean() * 2
    assert area == pytest.approx(mean(scores), abs=1e-3)


def test_improvement_is_the_mann_whitney_statistic_over_all_pairs() -> None:
    x, y = tasks(4, 5), tasks(6, 2, seed=1)
    expected = [mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in zip(x, y)]
    assert probability_of_improvement(x, y) == pytest.approx(np.mean(expected))
    assert probability_of_improvement(y, x) == pytest.approx(1 - np.mean(expected))


def test_improvement_counts_ties_as_half() -> None:
    one, zero = np.ones(3), np.zeros(2)
    assert probability_of_improvement([one], [zero]) == 1
    assert probability_of_improvement([zero], [one]) == 0
    assert probability_of_improvement([one], [one]) == 0.5
    assert probability_of_improvement([one, one], [zero, one]) == 0.75
    with pytest.raises(ValueError, match="got 1 and 2"):
        probability_of_improvement([one], [one, one])

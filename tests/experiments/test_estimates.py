from __future__ import annotations

import time

import numpy as np
import pytest

from crptpro.experiments.estimates import (
    estimate,
    estimate_curve,
    estimate_improvement,
    estimate_profile,
    estimate_relative,
)
from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.statistics import iqm, mean, median

TASKS = ("cheetah_run", "walker_run", "quadruped_run")


def runs(*counts: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {task: rng.normal(0.8, 0.4, count) for task, count in zip(TASKS, counts)}


def test_the_interval_of_a_mean_of_two_runs_has_its_closed_form() -> None:
    # Resamples of (0, 1) have means 0, 1/2 and 1 with probabilities 1/4, 1/2 and 1/4.
    wide = estimate({"t": [0.0, 1.0]}, mean)
    assert wide.interval == (0.0, 1.0)
    narrow = estimate({"t": [0.0, 1.0]}, mean, bootstrap=Bootstrap(confidence=0.4))
    assert narrow.interval == (0.5, 0.5)


def test_the_interval_of_a_mean_over_tasks_is_that_of_the_normal_law() -> None:
    scores = runs(40, 60, 50)
    found = estimate(scores, mean, bootstrap=Bootstrap(replicates=20_000))
    error = np.sqrt(sum(s.var() / len(s) for s in scores.values())) / 3
    np.testing.assert_allclose(
        found.interval, [found.value - 1.96 * error, found.value + 1.96 * error], atol=0.004
    )


def test_every_estimate_says_how_many_runs_it_stands_on() -> None:
    scores = runs(3, 2, 4)
    found = estimate(scores)
    assert (found.basis.tasks, found.basis.runs, found.basis.encoders) == (3, 9, None)
    assert str(found.basis) == "3 tasks, 9 runs, 95% interval over runs"
    assert str(found).endswith(f"({found.basis})")
    encoders = {task: [f"seed {i % 2}" for i in range(len(s))] for task, s in scores.items()}
    assert str(estimate(scores, encoders=encoders).basis) == (
        "3 tasks, 9 runs of 2 encoders, 95% interval over encoders"
    )
    assert estimate_profile(scores, [0.5]).basis.runs == 9
    assert estimate_improvement(scores, runs(1, 5, 5)).basis.runs == 20


def test_a_single_run_has_no_interval_and_says_so() -> None:
    found = estimate({"cheetah_run": [0.4], "walker_run": [0.1, 0.3]}, mean)
    assert found.value == pytest.approx(0.3)
    assert found.interval is None
    assert found.basis.why_no_interval == "no interval: a single run on cheetah_run"
    assert f"{found:.2f}" == "0.30 [no interval]"
    profile = estimate_profile({"cheetah_run": [0.4]}, [0.0, 1.0])
    assert profile.low is None
    assert profile.high is None
    assert profile.values.tolist() == [1.0, 0.0]
    versus = estimate_improvement({"t": [1.0, 2.0]}, {"t": [0.0]})
    assert versus.interval is None


def test_many_runs_of_a_single_encoder_tell_nothing_about_the_next_encoder() -> None:
    scores = {"t": np.arange(10.0)}
    assert estimate(scores, mean).interval is not None
    found = estimate(scores, mean, encoders={"t": ["only"] * 10})
    assert found.interval is None
    assert found.basis.why_no_interval == "no interval: a single encoder on t"


def test_the_seed_decides_the_interval_and_the_order_of_tasks_does_not() -> None:
    scores = runs(5, 4, 3)
    first = estimate(scores)
    assert estimate(scores) == first
    assert estimate(dict(reversed(scores.items()))).interval == first.interval
    other = estimate(scores, bootstrap=Bootstrap(seed=1))
    assert other.interval != first.interval
    assert other.value == first.value


def test_a_wider_confidence_has_a_wider_interval() -> None:
    ends = [estimate(runs(5, 5, 5), bootstrap=Bootstrap(confidence=c)).interval for c in (0.5, 0.8, 0.99)]
    assert ends[2][0] < ends[1][0] < ends[0][0] < ends[0][1] < ends[1][1] < ends[2][1]


def test_shared_encoders_move_all_their_tasks_together() -> None:
    # One run per encoder and task; the first encoder scores 0 everywhere, the second 1.
    scores = {task: [0.0, 1.0] for task in TASKS}
    encoders = {task: ["a", "b"] for task in TASKS}
    drawn = Bootstrap(confidence=0.9, replicates=4000)
    assert estimate(scores, mean, encoders=encoders, bootstrap=drawn).interval == (0.0, 1.0)
    # Redrawn task by task, all six runs are of one encoder in 1 of 32 replicates only.
    low, high = estimate(scores, mean, bootstrap=drawn).interval
    assert low > 0.1
    assert high < 0.9


def test_intervals_over_encoders_cover_the_method_and_those_over_runs_do_not() -> None:
    rng = np.random.default_rng(0)
    covered = np.zeros(2)
    experiments, encoders, each = 150, 10, 3
    labels = {task: [str(e) for e in range(encoders) for _ in range(each)] for task in TASKS}
    how = Bootstrap(replicates=300)
    for _ in range(experiments):
        quality = rng.normal(size=(encoders, 1))  # of an encoder, on all tasks; the method's mean is 0
        scores = {task: (quality + 0.5 * rng.normal(size=(encoders, each))).ravel() for task in TASKS}
        for level, told in enumerate((None, labels)):
            low, high = estimate(scores, mean, encoders=told, bootstrap=how).interval
            covered[level] += low <= 0 <= high
    over_runs, over_encoders = covered / experiments
    assert over_encoders > 0.85
    assert over_runs < 0.6


def test_a_curve_is_the_estimate_of_every_place() -> None:
    rng = np.random.default_rng(0)
    curves = {task: rng.normal(size=(count, 4)) for task, count in zip(TASKS, (3, 4, 5))}
    found = estimate_curve([0, 10, 20, 30], curves, mean)
    assert found.x.tolist() == [0, 10, 20, 30]
    for place in range(4):
        alone = estimate({task: c[:, place] for task, c in curves.items()}, mean)
        assert found.values[place] == pytest.approx(alone.value)
        assert (found.low[place], found.high[place]) == pytest.approx(alone.interval)
    with pytest.raises(ValueError, match=r"cheetah_run must be \[runs, 3\]"):
        estimate_curve([0, 10, 20], curves)


def test_a_profile_has_pointwise_intervals_within_zero_and_one() -> None:
    found = estimate_profile(runs(5, 4, 6), np.linspace(-1, 3, 30))
    assert (np.diff(found.values) <= 0).all()
    assert ((found.low >= 0) & (found.low <= found.values) & (found.values <= found.high)).all()
    assert (found.high <= 1).all()


def test_improvement_over_encoders_is_wider_than_over_runs() -> None:
    rng = np.random.default_rng(0)
    labels = {task: [str(e) for e in range(4) for _ in range(5)] for task in TASKS}

    def sample(shift: float) -> dict[str, np.ndarray]:
        quality = rng.normal(size=(4, 1))
        return {t: (shift + quality + 0.2 * rng.normal(size=(4, 5))).ravel() for t in TASKS}

    x, y = sample(0.5), sample(0.0)
    plain = estimate_improvement(x, y)
    nested = estimate_improvement(x, y, encoders=labels, other_encoders=labels)
    assert nested.value == plain.value
    assert np.diff(nested.interval) > 1.5 * np.diff(plain.interval)


@pytest.mark.parametrize(
    ("scores", "options", "message"),
    [
        ({}, {}, "no tasks"),
        ({"a": []}, {}, r"a must be \[runs\]"),
        ({"a": [[1.0]]}, {}, r"got shape \(1, 1\)"),
        ({"a": [1.0, 2.0], "b": [1.0, float("nan")]}, {}, "Run 1 of b has the score nan"),
        ({"a": [1.0, 2.0]}, {"encoders": {"a": ["x"]}}, "a has 2 runs, and encoders are told of 1"),
        ({"a": [1.0, 2.0]}, {"encoders": {}}, "a has 2 runs, and encoders are told of 0"),
    ],
)
def test_scores_that_cannot_be_aggregated_are_named(scores: dict, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        estimate(scores, **options)


def test_methods_are_compared_on_the_same_tasks_and_level_only() -> None:
    with pytest.raises(ValueError, match="on quadruped_run; compare"):
        estimate_improvement(runs(3, 3, 3), runs(3, 3))
    with pytest.raises(ValueError, match="both methods or of none"):
        estimate_improvement(runs(2), runs(2), encoders={TASKS[0]: ["a", "b"]})


@pytest.mark.parametrize(
    ("name", "value"), [("confidence", 1.0), ("confidence", 0.0), ("replicates", 0), ("seed", -1)]
)
def test_a_bootstrap_that_cannot_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        Bootstrap(**{name: value})


@pytest.mark.parametrize("aggregate", [iqm, mean, median])
def test_two_thousand_replicates_of_the_papers_table_take_well_below_a_second(aggregate) -> None:
    rng = np.random.default_rng(0)
    scores = {f"task {i}": rng.normal(size=5) for i in range(12)}
    encoders = {task: list("abcde") for task in scores}
    spent = []
    for _ in range(3):
        start = time.process_time()
        estimate(scores, aggregate, encoders=encoders)
        spent.append(time.process_time() - start)
    assert min(spent) < 0.5


def test_a_run_that_stands_in_two_rows_counts_once_and_leaves_the_interval_as_wide_as_it_is() -> None:
    scores, names = np.array([0.1, 0.3, 0.5, 0.9]), tuple("abcd")
    once = estimate({"walker_run": scores}, mean)
    twice = estimate(
        {"A walker_run": scores, "D walker_run": scores},
        mean,
        runs={"A walker_run": names, "D walker_run": names},
    )
    assert twice.value == once.value
    assert twice.basis.runs == once.basis.runs == 4
    assert once.interval is not None
    assert twice.interval == pytest.approx(once.interval, abs=0.02)
    apart = estimate({"A walker_run": scores, "D walker_run": scores}, mean)
    assert apart.basis.runs == 8
    assert apart.interval is not None
    assert apart.interval[1] - apart.interval[0] < 0.8 * (once.interval[1] - once.interval[0])


def test_a_ratio_knows_that_its_denominator_was_measured_too() -> None:
    scores = {"walker_run": [40.0, 45.0, 55.0, 60.0], "hopper_hop": [10.0, 14.0, 16.0, 20.0]}
    drq = {"walker_run": [60.0, 140.0, 100.0], "hopper_hop": [20.0, 40.0]}
    found = estimate_relative(scores, drq)
    assert found.value == pytest.approx((50 / 100 + 15 / 30) / 2)
    exact = estimate({task: np.array(own) / np.mean(drq[task]) for task, own in scores.items()}, mean)
    assert found.value == pytest.approx(exact.value)
    assert found.interval is not None
    assert exact.interval is not None
    assert found.interval[0] < exact.interval[0]
    assert found.interval[1] > exact.interval[1]
    assert found.basis.runs == 8 + 5
    with pytest.raises(ValueError, match="reference scored 0 or less on hopper_hop"):
        estimate_relative(scores, {**drq, "hopper_hop": [0.0, 30.0]})
    with pytest.raises(ValueError, match="Only one of the methods has runs on hopper_hop"):
        estimate_relative(scores, {"walker_run": [1.0, 2.0]})


def test_names_must_be_told_of_every_run() -> None:
    with pytest.raises(ValueError, match="walker_run has 2 runs, and names are told of 1"):
        estimate({"walker_run": [1.0, 2.0]}, runs={"walker_run": ("a",)})

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crptpro.experiments import statistics
from crptpro.experiments.statistics import COVERAGE, MIN_RUNS, estimate, mean, probability_of_improvement


def runs(scores: dict[str, list[float]], encoders: list[str] | None = None) -> pd.DataFrame:
    """A row per run; each has an encoder of its own unless they are told."""
    rows = [(task, f"{task} {place}", score) for task, each in scores.items() for place, score in enumerate(each)]
    table = pd.DataFrame(rows, columns=["task", "run", "score"])
    return table.assign(encoder=table["run"] if encoders is None else encoders)


def test_the_probability_of_improvement_counts_pairs_and_halves_ties() -> None:
    x, y = [np.array([1.0, 3.0])], [np.array([1.0, 2.0, 2.0])]
    assert probability_of_improvement(x, y) == pytest.approx((0.5 + 0 + 0 + 3) / 6)
    assert probability_of_improvement(y, x) == pytest.approx(1 - 3.5 / 6)
    alike = [np.ones(3)]
    assert probability_of_improvement(alike, alike) == 0.5
    assert statistics.relative_mean(x, y) == pytest.approx(2 / (5 / 3))


RLIABLE = json.loads(Path(__file__).with_name("rliable_values.json").read_text())
"""What google-research/rliable 1.2.0 computes on :func:`fixed_scores`, with 20,000 replicates."""


def fixed_scores(name: str, more: int = 0, shift: float = 0.0) -> pd.DataFrame:
    """Scores between 0 and 1.5, a tie here and there; of "5x12" five runs of twelve tasks."""
    count, tasks = map(int, name.split("x"))
    index = np.arange((count + more) * tasks).reshape(-1, tasks)
    matrix = np.round(0.75 + 0.75 * np.sin(1.7 * index**1.1 + 0.3), 2) + shift
    return runs({f"task_{i:02d}": list(column) for i, column in enumerate(matrix.T)})


@pytest.mark.parametrize("case", RLIABLE)
def test_values_and_intervals_are_rliables(case: str) -> None:
    found, own = RLIABLE[case], fixed_scores(case)
    for name, value in found["values"].items():
        ours = estimate(getattr(statistics, name), own, replicates=20_000, seed=1)
        assert ours.value == pytest.approx(value, abs=1e-12), name
        if int(case[0]) >= MIN_RUNS:  # both are Monte Carlo
            np.testing.assert_allclose([ours.low[0], ours.high[0]], found["intervals"][name], atol=0.02)
    above = pd.DataFrame({str(t): (own["score"] > t) * 1.0 for t in (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)})
    profile = estimate(mean, pd.concat([own, above], axis=1), columns=list(above))
    np.testing.assert_allclose(profile.value, found["profile"], atol=1e-12)
    better = estimate(probability_of_improvement, fixed_scores(case, 1, 0.1), own)
    assert better.value == pytest.approx(found["improvement"], abs=1e-12)
    if better.low is not None:  # few runs give few values, which jump
        np.testing.assert_allclose([better.low[0], better.high[0]], found["improvement_interval"], atol=0.05)


def test_below_five_runs_on_any_task_there_is_no_interval() -> None:
    few = runs({"a": [1.0] * 6, "b": [1.0, 2.0, 3.0, 4.0]})
    assert (estimate(mean, few).low, estimate(mean, few).high) == (None, None)
    assert f"{estimate(mean, few):.1f}" == "1.8"
    enough = runs({"a": [1.0] * 6, "b": [1.0, 2.0, 3.0, 4.0, 5.0]})
    assert estimate(mean, enough).low is not None
    assert f"{estimate(mean, enough):.1f}".startswith("2.0 [")
    # The other method's runs count, too.
    assert estimate(probability_of_improvement, enough, few).low is None


def test_the_same_runs_give_the_same_interval_in_any_order_and_another_seed_another() -> None:
    own = fixed_scores("6x3")
    first = estimate(statistics.iqm, own)
    again = estimate(statistics.iqm, own.sample(frac=1, random_state=3))
    assert (first.low, first.high) == (again.low, again.high)
    assert estimate(statistics.iqm, own, seed=1).low != first.low


def test_intervals_of_a_mean_have_the_stated_coverage() -> None:
    for count, share in COVERAGE.items():
        draws = pd.DataFrame(np.random.default_rng(0).normal(size=(count, 1_000)))  # a column per repetition
        own = pd.concat([runs({"a": [0.0] * count}), draws], axis=1)
        found = estimate(mean, own, columns=list(draws))
        assert ((found.low <= 0) & (found.high >= 0)).mean() == pytest.approx(share, abs=0.03)


def test_runs_that_share_encoders_have_the_wider_interval_of_their_encoders() -> None:
    # Three encoders that differ, three alike runs on each: nine runs tell no more than three encoders do.
    scores = {"a": [0.0] * 3 + [1.0] * 3 + [2.0] * 3}
    shared = estimate(mean, runs(scores, ["x"] * 3 + ["y"] * 3 + ["z"] * 3))
    alone = estimate(mean, runs(scores))
    assert shared.runs == 9
    assert shared.value == alone.value
    assert shared.high[0] - shared.low[0] > 1.4 * (alone.high[0] - alone.low[0])
    one = estimate(mean, runs(scores, ["x"] * 9))  # these runs of this encoder
    np.testing.assert_allclose([one.low, one.high], [alone.low, alone.high], atol=0.12)


def test_a_run_under_two_tasks_is_redrawn_alike_and_counts_once() -> None:
    own = runs({"A walker_run": [1.0, 2.0, 3.0, 4.0, 5.0]})
    both = pd.concat([own, own.assign(task="D walker_run")])
    alone, twice = estimate(mean, own), estimate(mean, both)
    assert twice.runs == 5
    np.testing.assert_allclose([twice.low, twice.high], [alone.low, alone.high])

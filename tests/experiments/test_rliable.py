from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from rliable_values import CASES, THRESHOLDS, reference, scores, sources

from crptpro.experiments import statistics
from crptpro.experiments.estimates import estimate, estimate_improvement
from crptpro.experiments.intervals import Bootstrap

measured = cache(reference)
EVERY = pytest.mark.parametrize(
    ("source", "case"), [(source, case) for source in sources() for case in CASES]
)


def by_task(matrix: np.ndarray) -> dict[str, np.ndarray]:
    return {f"task_{i:02d}": column for i, column in enumerate(matrix.T)}


def assert_ends_agree(ours: Sequence[float] | None, theirs: Sequence[float], source: str) -> None:
    """Both are Monte Carlo: of 20,000 replicates, or fewer where rliable is asked anew."""
    assert ours is not None
    np.testing.assert_allclose(ours, theirs, atol=0.02 if source == "kept" else 0.08)


@EVERY
def test_aggregates_are_rliables(source: str, case: str) -> None:
    for name, value in measured(source)[case]["values"].items():
        ours = getattr(statistics, name)(list(scores(*CASES[case]).T))
        assert ours == pytest.approx(value, abs=1e-12), name


@EVERY
def test_intervals_are_rliables_up_to_chance(source: str, case: str) -> None:
    how = Bootstrap(replicates=20_000, seed=1)
    for name, ends in measured(source)[case]["intervals"].items():
        ours = estimate(by_task(scores(*CASES[case])), getattr(statistics, name), bootstrap=how)
        assert_ends_agree(ours.interval, ends, source)


@EVERY
def test_profiles_are_rliables(source: str, case: str) -> None:
    ours = statistics.performance_profile(list(scores(*CASES[case]).T), THRESHOLDS)
    np.testing.assert_allclose(ours, measured(source)[case]["profile"], atol=1e-12)


@EVERY
def test_probabilities_of_improvement_are_rliables(source: str, case: str) -> None:
    runs, tasks = CASES[case]
    better, worse = by_task(scores(runs + 1, tasks, 0.1)), by_task(scores(runs, tasks))
    ours = estimate_improvement(better, worse, bootstrap=Bootstrap(replicates=20_000))
    assert ours.value == pytest.approx(measured(source)[case]["improvement"], abs=1e-12)
    # A tenth of the replicates: rliable's test statistic is slow. Few runs give few values, which jump.
    slack = 0.05 if source == "kept" else 0.2
    np.testing.assert_allclose(ours.interval, measured(source)[case]["improvement_interval"], atol=slack)

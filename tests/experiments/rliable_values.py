"""What google-research/rliable computes on fixed scores: kept here, and measured again where it is installed.

rliable is not among the packages of the test environment: the newest releases that its own requirements admit do not
run together (arch 7 calls a function of pandas that pandas 3 changed). To measure again::

    pip install rliable==1.2.0 'pandas<3'
    python tests/experiments/rliable_values.py
"""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np

FILE = Path(__file__).with_suffix(".json")
THRESHOLDS = [0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5]
REPLICATES = {"kept": 20_000, "installed": 500}


def scores(runs: int, tasks: int, shift: float = 0.0) -> np.ndarray:
    """Scores ``[runs, tasks]`` between 0 and 1.5, the same everywhere, a tie here and there."""
    index = np.arange(runs * tasks).reshape(runs, tasks)
    return np.round(0.75 + 0.75 * np.sin(1.7 * index**1.1 + 0.3), 2) + shift


CASES = {"5x12": (5, 12), "3x4": (3, 4), "2x1": (2, 1), "6x3": (6, 3), "7x2": (7, 2)}


def measure(replicates: int) -> dict:
    """Ask the installed rliable."""
    from rliable import library, metrics

    found: dict = {}
    aggregates = {
        "iqm": metrics.aggregate_iqm,
        "mean": metrics.aggregate_mean,
        "median": metrics.aggregate_median,
        "optimality_gap": metrics.aggregate_optimality_gap,
    }
    np.random.seed(0)  # noqa: NPY002 - rliable draws from the global generator
    for name, shape in CASES.items():
        x = scores(*shape)
        values = {key: float(f(x)) for key, f in aggregates.items()}
        _, intervals = library.get_interval_estimates(
            {"x": x}, lambda s: np.array([f(s) for f in aggregates.values()]), reps=replicates
        )
        ends = {key: intervals["x"][:, i].tolist() for i, key in enumerate(aggregates)}
        profile = library.score_distributions(x, np.array(THRESHOLDS)).tolist()
        y = scores(shape[0] + 1, shape[1], 0.1)
        _, between = library.get_interval_estimates(
            {"xy": [y, x]},
            lambda a, b: np.array([metrics.probability_of_improvement(a, b)]),
            reps=replicates // 10,
        )
        found[name] = {
            "values": values,
            "intervals": ends,
            "profile": profile,
            "improvement": float(metrics.probability_of_improvement(y, x)),
            "improvement_interval": between["xy"][:, 0].tolist(),
        }
    return found


def sources() -> list[str]:
    """The kept values, and those of the installed package if there is one."""
    return ["kept", "installed"] if find_spec("rliable") else ["kept"]


def reference(source: str) -> dict:
    """Values by case."""
    return measure(REPLICATES[source]) if source == "installed" else json.loads(FILE.read_text())


if __name__ == "__main__":
    FILE.write_text(json.dumps(measure(REPLICATES["kept"]), indent=1) + "\n")

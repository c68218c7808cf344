"""Every experiment of the paper at its smallest, from nothing to its report, on the real simulator."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from crptpro.experiments.building import Store
from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.goals import METHODS

pytestmark = [pytest.mark.gl, pytest.mark.slow, pytest.mark.timeout(1_200)]

Asked = dict[str, tuple[str, ...]]

PENDULUM = ("--tasks", "pendulum_swingup")
GROUP_D = ("--groups", "D", *PENDULUM)
FEW = ("--methods", "crptpro", "random-encoder")
ROOTS: dict[str, Asked] = {
    "every method": {"seen": GROUP_D, "finetune": GROUP_D},
    "prototypical methods": {
        "ablation": GROUP_D,
        "sensitivity": (*GROUP_D, "--methods", "crptpro"),
        "prototypes": GROUP_D,
        "stability": GROUP_D,
        "coverage": GROUP_D,
        "visualize": GROUP_D,
    },
    "few methods": {
        "unseen": ("--groups", "A", *PENDULUM, *FEW),
        "colors": ("--groups", "C", *PENDULUM, *FEW),
        "efficiency": ("--groups", "D", "--methods", "crptpro", "proto-rl-c", "apt-s"),
        "probe": (*GROUP_D, *FEW),
    },
}
SHORT_EPISODES = Path(__file__).with_name("short_episodes.py")


def crptpro(*arguments: object) -> str:
    """Run the command; return what it printed, failures with what it said."""
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from crptpro.cli import main; main()",
            "--plugin",
            str(SHORT_EPISODES),
            *map(str, arguments),
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert "Traceback" not in done.stderr
    return done.stdout


def test_no_experiment_of_the_paper_is_left_out() -> None:
    asked = [name for experiments in ROOTS.values() for name in experiments]
    assert sorted(asked) == sorted(set(EXPERIMENTS) - {"study"})


@pytest.mark.parametrize("experiments", ROOTS.values(), ids=ROOTS.keys())
def test_experiments_run_from_nothing_to_their_report(experiments: Asked, tmp_path: Path) -> None:
    store = Store(tmp_path)
    for name, flags in experiments.items():
        command = ("reproduce", name, "--scale", "tiny", "--launcher", "inline", "--out", tmp_path, *flags)
        crptpro(*command)
        written = json.loads((tmp_path / "experiments" / f"{name}-tiny.json").read_text())
        assert written["goals"]
        assert all(store.is_done(store.described(goal["key"])) for goal in written["goals"])
        again = crptpro(*command)
        assert "at a time" not in again
        assert "All of it is there" in again

    crptpro("report", tmp_path)
    page = (tmp_path / "report" / "index.html").read_text()
    text = (tmp_path / "report" / "report.md").read_text()
    for name in experiments:
        assert EXPERIMENTS[name].title in page
        assert EXPERIMENTS[name].title in text
    if "seen" in experiments:
        assert all(method in text for method in METHODS)

"""Every experiment of the paper at its smallest, from nothing to its report, on the real simulator."""

from __future__ import annotations

import html
import json
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.envs import EnvBase

from crptpro import cli
from crptpro.envs import factory
from crptpro.envs.episode_limit import EpisodeLimit
from crptpro.envs.own_env import with_transform
from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.goals import METHODS
from crptpro.experiments.store import Store

pytestmark = [
    pytest.mark.gl,
    pytest.mark.slow,
    pytest.mark.timeout(2_400),
]  # 20 min were too few on half a machine

PENDULUM = ("--tasks", "pendulum_swingup")
GROUP_D = ("--groups", "D", *PENDULUM)
FEW = ("--methods", "crptpro", "random-encoder")
ASKED: dict[str, tuple[str, ...]] = {
    "seen": GROUP_D,
    "finetune": GROUP_D,
    "ablation": GROUP_D,
    "sensitivity": (*GROUP_D, "--methods", "crptpro"),
    "prototypes": GROUP_D,
    "stability": GROUP_D,
    "coverage": GROUP_D,
    "visualize": GROUP_D,
    "unseen": ("--groups", "A", *PENDULUM, *FEW),
    "colors": ("--groups", "C", *PENDULUM, *FEW),
    "efficiency": ("--groups", "D", "--methods", "crptpro", "apt-s"),
    "probe": (*GROUP_D, *FEW),
}


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Threads and log lines are afterwards what they were."""
    library, threads = logging.getLogger("crptpro"), torch.get_num_threads()
    before = library.handlers[:], library.level, library.propagate
    yield
    torch.set_num_threads(threads)
    library.handlers[:], library.propagate = before[0], before[2]
    library.setLevel(before[1])


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a whole episode costs is not what this is about. Processes that collect have whole ones."""
    whole_episodes = factory._make_dm_env

    def ends_early(*arguments: Any, **settings: Any) -> EnvBase:
        return with_transform(whole_episodes(*arguments, **settings), EpisodeLimit(15))

    monkeypatch.setattr(factory, "_make_dm_env", ends_early)


def test_no_experiment_of_the_paper_is_left_out() -> None:
    assert sorted(ASKED) == sorted(set(EXPERIMENTS) - {"study"})


@pytest.mark.usefixtures("short_episodes")
def test_experiments_run_from_nothing_to_their_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def crptpro(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["crptpro", *map(str, arguments)])
        cli.main()
        return capsys.readouterr().out

    store = Store(tmp_path)
    for name, flags in ASKED.items():
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
    for name in ASKED:
        assert html.escape(EXPERIMENTS[name].title) in page
        assert EXPERIMENTS[name].title in text
    assert all(method in text for method in METHODS)

"""``crptpro reproduce``: the plan, refusals, and an experiment of a plugin's from nothing to an interrupted end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from command import Call, refused

import crptpro
from crptpro.errors import CRPTproError
from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.goals import Goal, Request
from crptpro.experiments.launching import Failure
from crptpro.experiments.plan import Plan

MAIN = "from crptpro.cli import main; main()"
FAKE_EXPERIMENT = Path(__file__).parents[1] / "experiments" / "launching" / "fake_experiment.py"


def numbers(out: str, pieces: str) -> list[str]:
    """Needed, done and to do, of a kind of pieces in a plan."""
    [row] = [line for line in out.splitlines() if line.startswith(pieces)]
    return row.removeprefix(pieces).split()[:3]


def test_a_dry_run_prints_the_plan_and_makes_nothing(call: Call, tmp_path: Path) -> None:
    status, out, err = call("reproduce", "seen", "--scale", "tiny", "--dry-run", "--out", tmp_path / "root")
    assert (status, err) == (0, "")
    assert numbers(out, "datasets of random transitions") == ["8", "0", "8"]
    # Twelve tasks and eleven methods, of which four do not ask for the group that four tasks are in twice.
    assert numbers(out, "downstream runs") == [str(12 * 11 - 4 * 4), "0", str(12 * 11 - 4 * 4)]
    assert "at a time" in out
    assert list(tmp_path.iterdir()) == []


def test_a_part_of_an_experiment_has_a_smaller_plan(call: Call, tmp_path: Path) -> None:
    part = (
        "--methods",
        "crptpro",
        "random-encoder",
        "--groups",
        "A",
        "--tasks",
        "walker_run",
        "--seeds",
        3,
        4,
    )
    asked = ("reproduce", "seen", "--scale", "tiny", *part, "--encoder-seeds", 0, 1)
    _, out, _ = call(*asked, "--dry-run", "--out", tmp_path)
    assert numbers(out, "downstream runs") == [
        "8",
        "0",
        "8",
    ]  # two methods, two encoders each, two runs on each


def test_what_an_experiment_does_not_read_is_said(call: Call, tmp_path: Path) -> None:
    options = ("--scale", "tiny", "--groups", "A", "--dry-run", "--out", tmp_path)

    def idle(*arguments: object) -> str:
        status, out, _ = call("reproduce", *arguments, *options)
        assert status == 0
        return "".join(line for line in out.splitlines() if line.startswith("Without effect on "))

    named = idle("seen", "--tasks", "walker_run", "hopper_hop", "--methods", "crptpro")
    assert named == "Without effect on seen: --tasks hopper_hop."
    named = idle("prototypes", "--methods", "atc", "crptpro", "--seeds", 5)
    assert named == "Without effect on prototypes: --methods atc, --seeds 5."
    assert idle("efficiency", "--tasks", "hopper_hop").endswith("--tasks hopper_hop.")
    assert idle("seen", "--colors-by", "image", "--seeds", 3).endswith("seen: --colors-by image.")
    # What one of several reads has an effect.
    assert (
        idle("seen", "prototypes", "--methods", "atc", "crptpro", "--tasks", "walker_run", "--seeds", 0) == ""
    )


def test_all_means_the_experiments_that_have_something_of_what_is_asked_for(
    call: Call, tmp_path: Path
) -> None:
    options = ("--scale", "tiny", "--dry-run", "--out", tmp_path)
    status, out, _ = call("reproduce", "all", "--groups", "B", *options)
    assert status == 0
    assert "Nothing of unseen, colors is among" in out
    assert "\nseen, " in out
    nothing = ("--methods", "drq", "--groups", "B", "--tasks", "quadruped_run")
    line = refused(call("reproduce", "all", *nothing, *options))
    assert "Nothing of seen, unseen" in line
    line = refused(call("reproduce", "all", "colors", "--groups", "B", *options))
    assert "Nothing of unseen, colors" in line


@pytest.mark.parametrize(("arguments", "message"), [
    (("sen", "--scale", "tiny"), "no experiment 'sen'. Did you mean 'seen'?"),
    (("seen", "--scale", "tiny", "--methods", "atcc"), "'atcc'"),
    (("seen", "--scale", "tiny", "--groups", "E"), "no group 'E'"),
    (("seen", "--scale", "tiny", "--groups", "A", "--tasks", "hopper_hop"), "Nothing of seen"),
    (("seen", "--scale", "tiny", "--partition", "gpu"), "--partition is for --launcher slurm; --launcher local does"),
    (("seen", "--scale", "tiny", "--launcher", "slurm", "--ray-address", "x:1"), "--ray-address is for --launcher ray"),
    (("seen", "--scale", "tiny", "--launcher", "inline", "--jobs", "2"), "one piece at a time, not --jobs 2"),
    (("seen", "--scale", "tiny", "--jobs-per-gpu", "2"), "--jobs-per-gpu is for --device cuda, not cpu"),
    (("seen", "--scale", "tiny", "--launcher", "ray", "--device", "cuda:1"), "write --device cuda, not cuda:1"),
    (("seen", "--scale", "tiny", "--jobs", "0"), "--jobs must be at least 1, got 0"),
    (("seen", "--scale", "tiny", "--attempts", "0"), "--attempts must be at least 1, got 0"),
    (("seen", "--scale", "tiny", "--device", "cuda:99"), "cuda:99"),
    (("seen", "--scale", "tiny", "--launcher", "slurm", "--hours", "0"), "--hours must be at least a minute"),
    (("seen", "--scale", "tiny", "--launcher", "slurm", "--memory-gb", "0.1"), "--memory-gb must be at least 1"),
    (("seen", "--scale", "tiny", "--launcher", "slurm", "--sbatch", "qos"), "--sbatch qos: write key=value"),
])  # fmt: skip
def test_a_request_that_cannot_be_met_leaves_nothing_behind(
    call: Call, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    line = refused(call("reproduce", *arguments, "--out", tmp_path / "root"))
    assert message in line
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra_nothing_is_written(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    status, out, err = call(
        "reproduce", "seen", "--scale", "tiny", "--launcher", "ray", "--out", tmp_path / "root"
    )
    assert status == 1
    assert "downstream runs" in out
    assert "pip install 'crptpro[ray]'" in err
    assert list(tmp_path.iterdir()) == []


def test_failures_are_listed_also_where_an_error_ends_the_command(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(plan: Plan, *_: object, failures: list[Failure], **__: object) -> None:
        failures.append(Failure(plan.missing[0], "it will never do", tmp_path / "log.txt", 1))
        raise CRPTproError("There is no queue any more.")

    monkeypatch.setattr("crptpro.experiments.launching.run_pieces", ended)
    options = ("--scale", "tiny", "--groups", "A", "--launcher", "inline", "--out", tmp_path / "root")
    status, out, err = call("reproduce", "seen", *options)
    assert status == 1
    assert "1 failed:" in out
    assert "it will never do" in out
    assert "There is no queue any more." in err


def test_a_plan_that_the_disk_cannot_hold_is_refused(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 10**9})())
    status, _, err = call(
        "reproduce", "seen", "--scale", "paper", "--launcher", "inline", "--out", tmp_path / "root"
    )
    assert status == 1
    assert "has 1.00 GB free" in err
    assert list(tmp_path.iterdir()) == []


def test_colours_are_reversed_by_background_or_image(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, asked = EXPERIMENTS["colors"], []

    def goals(request: Request) -> list[Goal]:
        asked.append({goal.piece.colors for goal in usual.goals(request)})  # type: ignore[attr-defined]
        return usual.goals(request)

    monkeypatch.setitem(EXPERIMENTS, "colors", replace(usual, goals=goals))
    part = ("--methods", "random-encoder", "--scale", "tiny")
    for by in ("background", "image"):
        asked.clear()
        assert call("reproduce", "colors", *part, "--colors-by", by, "--dry-run", "--out", tmp_path)[0] == 0
        assert asked[0] == {f"reversed_{by}"}


# --- an experiment that takes seconds -----------------------------------------------------------------------------


class Command:
    """The command in a process of its own, the first of a process group as in a terminal."""

    def __init__(self, root: Path, *arguments: object) -> None:
        command = [sys.executable, "-c", MAIN, "--plugin", FAKE_EXPERIMENT, "reproduce", *arguments]
        source = str(Path(crptpro.__file__).parents[1])
        path = os.pathsep.join([source, os.environ.get("PYTHONPATH", "")])
        self.root = root
        self.process = subprocess.Popen(
            [*map(str, command), "--scale", "tiny", "--out", str(root)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": path},
        )

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=120)
        return self.process.returncode, out, err

    def counts(self) -> dict[str, int]:
        return {
            path.parent.name.split("-")[1]: int(path.read_text())
            for path in self.root.glob("pieces/*/count.txt")
        }

    def jobs_of(self, *names: str) -> list[psutil.Process]:
        """All processes that the command has started, once the jobs of these pieces have begun."""
        deadline = time.monotonic() + 90
        while time.monotonic() < deadline and not set(names) <= set(self.counts()):
            time.sleep(0.05)
        return psutil.Process(self.process.pid).children(recursive=True)


def alive(processes: list[psutil.Process], *, within_s: float) -> list[psutil.Process]:
    """Those that have not ended by then; nobody may be there to collect orphans."""
    deadline = time.monotonic() + within_s
    while (left := [p for p in processes if _lives(p)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    return left


def _lives(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def begun(root: Path) -> dict[str, list[int]]:
    """What the attempts at each long piece counted on from."""
    found = {}
    for path in root.glob("pieces/*/attempts.txt"):
        name = path.parent.name.split("-")[1]
        found[name] = [int(line.split()[0].removeprefix("from=")) for line in path.read_text().splitlines()]
    return {name: values for name, values in found.items() if name in ("crptpro", "atc")}


@pytest.mark.slow
def test_ctrl_c_stops_the_jobs_at_a_checkpoint_and_the_same_command_continues(tmp_path: Path) -> None:
    root = tmp_path / "root"
    first = Command(root, "fake", "--jobs", 2)
    jobs = first.jobs_of("crptpro", "atc")
    os.killpg(first.process.pid, signal.SIGINT)  # as a terminal does
    status, out, err = first.end()
    assert status == 130, err
    assert "the same command continues" in err
    assert not alive(jobs, within_s=1)
    counts = first.counts()
    assert 1 <= counts["crptpro"] < 40
    assert not list(root.glob("pieces/*/*.partial"))
    assert len(list(root.glob("pieces/*/done.json"))) == 1
    asked = json.loads((root / "experiments" / "fake-tiny.json").read_text())
    assert [goal["label"] for goal in asked["goals"]] == ["crptpro", "atc"]

    status, out, err = Command(root, "fake", "--jobs", 2).end()
    assert status == 0, err
    assert f"crptpro report {root}" in out
    # The jobs wrote a checkpoint when they were stopped, and went on from it.
    assert begun(root) == {name: [0, counts[name]] for name in ("crptpro", "atc")}


@pytest.mark.slow
def test_jobs_whose_command_was_killed_leave_a_checkpoint_and_the_same_command_continues(
    tmp_path: Path,
) -> None:
    root = tmp_path / "root"
    first = Command(root, "fake", "--jobs", 2)
    jobs = first.jobs_of("crptpro", "atc")
    assert len(jobs) >= 2
    first.process.kill()
    first.process.wait()
    assert not alive(jobs, within_s=10)
    counts = first.counts()
    assert 1 <= counts["crptpro"] < 40
    assert not list(root.glob("pieces/*/*.partial"))
    assert "is gone" in next(root.glob("pieces/*-crptpro-*/log.txt")).read_text()
    status, _, err = Command(root, "fake", "--jobs", 2).end()
    assert status == 0, err
    assert begun(root) == {name: [0, counts[name]] for name in ("crptpro", "atc")}


@pytest.mark.slow
def test_failures_are_listed_with_their_logs_and_the_exit_status_says_so(tmp_path: Path) -> None:
    status, out, err = Command(tmp_path / "root", "broken", "--launcher", "local").end()
    assert status == 1, err
    assert "1 failed:" in out
    assert "missing-data will never do." in out
    [log] = [Path(line.split("log: ")[1]) for line in out.splitlines() if "log: " in line]
    assert "error: missing-data will never do." in log.read_text()
    assert "1 skipped" in out

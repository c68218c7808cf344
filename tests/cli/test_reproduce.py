"""``crptpro reproduce``: the plan, refusals, what failed, and a small reproduction from nothing to its report."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import torch
from command import Call, refused
from toy_env import FIXED

from crptpro import domains
from crptpro.artifact import read_json
from crptpro.cli import main
from crptpro.experiments import launch, matrix
from crptpro.experiments.jobs import KINDS, load_results
from crptpro.experiments.launch import Failure, Work
from crptpro.experiments.report import build_report

PART = ("--groups", "A", "--tasks", "walker_run")


def numbers(out: str, jobs: str) -> list[str]:
    """Needed, done and to do, of a kind of jobs in a plan."""
    [row] = [line.strip() for line in out.splitlines() if line.strip().startswith(jobs)]
    return row.removeprefix(jobs).split()[:3]


def test_a_dry_run_prints_the_plan_and_writes_nothing(call: Call) -> None:
    status, out, err = call("reproduce", "seen", "--scale", "tiny", "--dry-run", "--out", "root")
    assert (status, err) == (0, "")
    assert numbers(out, "datasets of random transitions") == ["8", "0", "8"]
    # Twelve tasks and thirteen methods, of which four do not ask for the group that four tasks are in twice.
    assert numbers(out, "downstream runs") == [str(12 * 13 - 4 * 4), "0", str(12 * 13 - 4 * 4)]
    assert "2,080" in next(line for line in out.splitlines() if "datasets" in line)  # env steps
    assert "the disk needs" in out
    assert "Runs behind each score: 1; the paper has at least 6" in out
    # A part: two methods, two encoders each, three runs on each. A domain means its task.
    part = ("--methods", "crptpro", "random-encoder", *PART, "walker", "--seeds", 3, 4, 5, "--encoder-seeds", 0, 1)
    _, out, _ = call("reproduce", "seen", "--scale", "tiny", *part, "--dry-run", "--out", "root")
    assert numbers(out, "downstream runs") == ["12", "0", "12"]
    assert "Runs behind" not in out
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(("experiment", "request_", "named"), [
    ("unseen", ("--methods", "crptpro", "proto-rl-s"), "proto-rl-s"),
    ("seen", ("--groups", "A", "--tasks", "walker_run", "hopper_hop"), "hopper_hop"),
    ("prototypes", ("--methods", "crptpro", "atc"), "atc"),
    ("efficiency", ("--groups", "A", "--methods", "crptpro", "drq"), "drq"),
    ("probe", ("--groups", "A", "--methods", "crptpro", "--tasks", "hopper_hop"), ""),
    ("ablation", ("--groups", "A", "--methods", "crptpro", "--tasks", "walker_run"), ""),
    ("sensitivity", ("--groups", "A", "--methods", "crptpro", "--tasks", "walker_run"), ""),
])  # fmt: skip
def test_a_plan_names_what_was_requested_and_is_no_part_of_an_experiment(
    call: Call, experiment: str, request_: tuple[str, ...], named: str
) -> None:
    status, out, _ = call("reproduce", experiment, *request_, "--scale", "tiny", "--dry-run")
    assert status == 0
    assert (f"Not part of {experiment}, and left out: {named}." in out) == bool(named)
    assert ("left out" in out) == bool(named)


@pytest.mark.parametrize(("free_gb", "jobs", "hint"), [
    (96, 1, r""),
    (96, 16, r"Each job can use 4\.8 GB of memory for dense maps\. .* The maps take [\d.]+ GB for crptpro \(they fit "
             r"with --jobs 4\); [\d.]+ GB for proto-rl-c \(they fit with --jobs 1\)\."),
    (48, 1, r"The maps take [\d.]+ GB for proto-rl-c \(more than this machine has free\)\."),
])  # fmt: skip
def test_a_plan_says_which_dense_maps_do_not_fit(
    call: Call, monkeypatch: pytest.MonkeyPatch, free_gb: int, jobs: int, hint: str
) -> None:
    monkeypatch.setattr("crptpro.cli.reproduce.free_bytes", lambda _: free_gb * 1e9)
    monkeypatch.setattr("crptpro.cli.reproduce.resolve_precision", lambda *_: torch.bfloat16)
    plan = ("--methods", "crptpro", "proto-rl-c", "--jobs", jobs, "--scale", "paper", "--dry-run")
    _, out, _ = call("reproduce", "seen", *plan)
    assert ("for dense maps" in out) == bool(hint)
    assert re.search(hint, out)


def test_all_means_the_experiments_with_requested_cells(call: Call) -> None:
    options = ("--groups", "B", "--scale", "tiny", "--dry-run")
    status, out, err = call("reproduce", "all", *options)
    assert status == 0, err
    assert out.startswith("seen, finetune, ablation")
    line = refused(call("reproduce", "all", "colors", *options))
    assert "Nothing of unseen, colors" in line


@pytest.mark.parametrize(("arguments", "message"), [
    (("sen",), "no experiment 'sen'; choose from seen, unseen"),
    (("seen", "--methods", "atcc"), "'atcc'"),
    (("seen", "--groups", "E"), "no group 'E'"),
    (("seen", "--tasks", "walker_ran"), "walker_ran"),
    (("seen", "--groups", "A", "--tasks", "hopper_hop"), "Nothing of seen"),
    (("seen", "--seeds", "1", "1"), "`seeds` must be different numbers"),
    (("seen", "--seeds", "1000"), "from 0 to 999"),
    (("seen", "--encoder-seeds"), "`encoder_seeds` must be"),
    (("seen", "--partition", "gpu"), "--partition is for --launcher slurm; --launcher local does"),
    (("seen", "--launcher", "slurm", "--ray-address", "x:1"), "--ray-address is for --launcher ray"),
    (("seen", "--jobs-per-gpu", "2"), "--jobs-per-gpu is for --device cuda, not cpu"),
    (("seen", "--launcher", "ray", "--device", "cuda:1"), "write --device cuda, not cuda:1"),
    (("seen", "--jobs", "0"), "--jobs must be at least 1, got 0"),
    (("seen", "--device", "cuda:99"), "cuda:99"),
    (("seen", "--launcher", "slurm", "--hours", "0"), "a job needs a minute and 1 GB at least"),
    (("seen", "--launcher", "slurm", "--memory-gb", "0.1"), "a job needs a minute and 1 GB at least"),
    (("seen", "--launcher", "slurm", "--sbatch", "qos"), "--sbatch qos: write key=value"),
])  # fmt: skip
def test_an_impossible_request_leaves_nothing_behind(call: Call, arguments: tuple[str, ...], message: str) -> None:
    assert message in refused(call("reproduce", "--scale", "tiny", *arguments))
    assert list(Path().iterdir()) == []


def test_what_a_launcher_or_the_disk_lacks_is_said_after_the_plan(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr("shutil.which", lambda name: None)
    disk = SimpleNamespace(free=10**12)
    monkeypatch.setattr("shutil.disk_usage", lambda path: disk)
    part = ("reproduce", "seen", "--scale", "paper", *PART)
    for launcher, missing in (("ray", "pip install 'crptpro[ray]'"), ("slurm", "needs sbatch and srun")):
        status, out, err = call(*part, "--launcher", launcher)
        assert status == 1
        assert "downstream runs" in out
        assert missing in err
    disk.free = 10**9
    assert "has 1.00 GB free" in call(*part)[2]
    assert list(Path().iterdir()) == []


def test_failures_are_listed_with_their_logs(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = Failure("run-a", "it will never do", Path("log.txt"), 3)
    monkeypatch.setattr(launch, "run_jobs", lambda *_, **__: [lost, Failure("run-b", "needs run-a")])
    status, out, _ = call("reproduce", "seen", "--scale", "tiny", *PART)
    assert status == 1
    assert "1 failed:\n  run-a (tried 3 times)\n    it will never do\n    log: log.txt\n" in out
    assert "1 not started, because they need one that failed:\n  run-b" in out


# --- a reproduction -------------------------------------------------------------------------------------------------


class InProcess:
    """A launcher that runs a job where it is started."""

    is_one_machine = True

    def __init__(self, gpus: tuple[str, ...], *, jobs: int) -> None: ...

    def start(self, work: Work, *, is_exclusive: bool) -> Any:
        log = open(work.directory / "log.txt", "a", buffering=1)  # noqa: SIM115
        with log, redirect_stdout(log), redirect_stderr(log):
            work.run(main)
        return self

    def poll(self) -> str:
        return ""


def reproduce(root: Path, *arguments: str) -> None:
    """Run a part of a tiny reproduction in this process."""
    part = ("--scale", "tiny", "--groups", "T", "--jobs", "1", "--cores-per-job", "1")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["crptpro", "reproduce", *arguments, *part, "--out", str(root)])
        main()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A reproduction of a group of one environment without a simulator: every kind of job."""
    root = tmp_path_factory.mktemp("tiny")
    few = {"env_steps": 24, "random_agent_steps": 4, "checkpoint_interval_env_steps": 24}
    scale = replace(
        matrix.TINY, updates=2, timing_updates=1, coverage_samples=24, probe_transitions=None,
        run={**matrix.TINY.run, **few, "eval_interval_env_steps": 24},
        explore_single={**matrix.TINY.explore_single, "env_steps": 60, "encoder_update_interval": 8},
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launch, "LocalLauncher", InProcess)
        patch.setattr(domains, "_registered", {})
        domains.register_domain(FIXED)
        patch.setitem(domains.GROUPS, "T", (FIXED.name,))
        patch.setitem(matrix.SCALES, "tiny", scale)
        patch.setitem(matrix.SINGLE_DOMAIN, "T", FIXED.name)
        patch.setitem(matrix.PROBED_UNSEEN, "T", ())
        reproduce(root, "seen", "--methods", "crptpro-finetune", "drq", "random-encoder")
        reproduce(root, "prototypes", "efficiency", "--methods", "crptpro")
        reproduce(root, "coverage", "visualize", "--methods", "proto-rl-s")
        reproduce(root, "efficiency", "--methods", "proto-rl-s")
        reproduce(root, "probe", "--methods", "random-encoder", "crptpro")
        yield root


def files(root: Path, kind: str, name: str) -> list[pd.DataFrame]:
    jobs = load_results(root).jobs
    return [pd.read_csv(path / name) for path in jobs[(jobs.kind == kind) & jobs.done].path]


def test_every_cell_of_a_reproduction_is_filled_and_reported(tiny: Path, tmp_path: Path) -> None:
    results = load_results(tiny)
    assert results.cells.done.all()
    assert results.jobs.done.all()
    assert set(results.jobs.kind) == set(KINDS)
    for path in results.jobs.path:
        assert (path / "log.txt").read_text().splitlines()[-1] == "finished"
        assert not {"checkpoints", "clock.json", "timed"} & {each.name for each in path.iterdir()}
    runs = files(tiny, "run", "eval.csv")
    assert [{*rows.env_steps} for rows in runs] == [{0, 24}] * 3
    assert {method for rows in runs for method in rows.method} == {"crptpro-finetune", "drq", "random-encoder"}
    text = build_report(tiny, out=tmp_path).with_name("report.md").read_text()
    assert text.count("\nFinished: ") == 6
    assert "Missing" not in text
    assert "Left out" not in text
    spread = text[text.index("Spread of the prototypes at the end") :]
    for variant in ("crptpro", "crptpro without dispersion"):
        numbers = r" 1 \| 2 \|( -?\d+\.\d{3}( · paper -?\d+\.\d{3})? \|){4}\n"
        assert re.search(rf"^\| {variant} \|{numbers}", spread, re.MULTILINE)


def test_the_same_command_finds_everything_finished(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in tiny.glob("jobs/*/*")}
    reproduce(tiny, "seen", "--methods", "random-encoder", "drq")
    out = capsys.readouterr().out
    assert numbers(out, "downstream runs") == ["2", "2", "0"]
    assert "Everything requested is finished" in out
    assert {path: path.stat().st_mtime_ns for path in tiny.glob("jobs/*/*")} == before
    labels = {cell["label"] for cell in read_json(tiny / "experiments" / "seen-tiny.json")["cells"]}
    assert labels == {"crptpro-finetune", "drq", "random-encoder"}  # nothing asked for before is lost


def test_measurements_of_encoders_and_data(tiny: Path) -> None:
    [covered] = files(tiny, "coverage", "coverage.csv")
    assert {*covered.source} == {"random", "explorer"}
    assert (covered.coverage > 0).all()
    [embedded] = files(tiny, "embeddings", "embeddings.csv")
    assert embedded.source.value_counts().to_dict() == {"toy-fixed random": 8, "toy-fixed explorer": 8}
    [explained] = tiny.glob("jobs/embeddings-*/explained.json")
    assert 0 < sum(read_json(explained)["explained_variance_ratio"]) <= 1
    probes = pd.concat(files(tiny, "probe", "probe.csv"))
    assert list(probes) == [
        "encoder", "method", "domain", "seen", "colors", "embedding", "measure", "coordinate", "value", "samples",
        "held_out_episodes", "seed",
    ]  # fmt: skip
    assert {*zip(probes.method, probes.seen)} == {("random-encoder", "no"), ("crptpro", "yes")}
    assert {*probes.embedding} == {"features", "z"}


def test_timings_are_projected_to_whole_budgets(tiny: Path) -> None:
    found = pd.concat(files(tiny, "timing", "timing.csv")).set_index("method")
    assert {*found.index} == {"crptpro", "proto-rl-s"}
    assert (found.seconds_per_update > 0).all()
    assert found.projected_hours.to_list() == pytest.approx(found.seconds_per_update * found.budget_updates / 3600)
    assert (found.encoder_updates >= 1).all()
    assert (found.decisions > 0).to_dict() == {"crptpro": False, "proto-rl-s": True}
    assert found.paper_projected_hours.isna().all()  # this scale does not time the paper's batches
    assert found.paper_updates.to_dict() == {"crptpro": 50_000, "proto-rl-s": 249_500}
    assert found.collection_seconds.notna().to_dict() == {"crptpro": True, "proto-rl-s": False}

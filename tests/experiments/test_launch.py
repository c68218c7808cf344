"""Which jobs run when, where they run, and what becomes of those that fail."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import psutil
import pytest
from filelock import FileLock

from crptpro import plugins
from crptpro.artifact import read_json, write_json
from crptpro.cli import main
from crptpro.errors import CRPTproError, SubmissionError
from crptpro.experiments import launch
from crptpro.experiments.jobs import Job, describe, make_plan
from crptpro.experiments.launch import Failure, RayLauncher, SlurmLauncher, Work, run_jobs

UNTRAINED = Job("untrained", "u", ("pretrain", "--method", "random-encoder", "--out", "{out}", "--seed", "0"), {})


def job(name: str, *needs: Job, kind: str = "run", **facts: Any) -> Job:
    return Job(kind, name, ("evaluate", name, *(f"{{{n.key}}}/x" for n in needs)), facts, needs)


class FakeLauncher:
    """Notes what it is told; every job ends when it is looked at."""

    is_one_machine = True

    def __init__(self, *, lost: dict[str, int] | None = None, answers: Iterable[str] = ()) -> None:
        self.started, self.stopped = list[tuple[str, int]](), list[tuple[str, bool]]()
        self.running, self.at_once = set[str](), list[int]()
        self.lost, self.answers, self.at_look = Counter(lost), iter(answers), lambda: None

    def run(self, root: Path, *wanted: Job, **how: Any) -> list[Failure]:
        return run_jobs(make_plan(wanted, root), root, self, **how)

    def start(self, work: Work, *, is_exclusive: bool) -> Any:
        if refusal := next(self.answers, ""):
            raise SubmissionError(refusal)
        name = work.key.split("-")[1]
        self.started.append((name, work.threads))
        self.running.add(name)
        self.at_once.append(len(self.running))

        def poll() -> str:
            self.at_look()
            self.running.discard(name)
            if self.lost[name]:
                self.lost[name] -= 1
                return "it was lost"
            write_json(work.directory / "done.json", {})
            return ""

        return SimpleNamespace(poll=poll, stop=lambda at_once: self.stopped.append((name, at_once)))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "POLL_S", 0.01)
    monkeypatch.setattr(launch, "REFUSED_S", 0.01)


def test_a_job_starts_when_its_needs_are_finished(tmp_path: Path) -> None:
    a, b = job("a"), job("b")
    wanted, launcher, again = (job("c", a, b), job("d", a), job("e")), FakeLauncher(), FakeLauncher()
    assert launcher.run(tmp_path, *wanted, jobs=2) == []
    order = [name for name, _ in launcher.started]
    assert sorted(order) == ["a", "b", "c", "d", "e"]
    assert order.index("c") > max(order.index("a"), order.index("b"))
    assert max(launcher.at_once) == 2
    again.run(tmp_path, *wanted)
    assert again.started == []


def test_a_timing_runs_alone_and_has_the_threads_of_its_plan(tmp_path: Path) -> None:
    launcher = FakeLauncher()
    timings = [job(name, kind="timing", threads=5) for name in ("t", "u")]
    launcher.run(tmp_path, timings[0], job("a"), job("b"), timings[1], jobs=2, cores=3)
    assert sorted(launcher.started) == [("a", 3), ("b", 3), ("t", 5), ("u", 5)]
    assert sorted(launcher.at_once) == [1, 1, 1, 2]


def test_a_lost_job_is_retried_and_dependents_of_a_failed_job_do_not_start(tmp_path: Path) -> None:
    bad, lucky = job("bad"), job("lucky")
    launcher = FakeLauncher(lost={"bad": 9, "lucky": 1})
    wanted = (job("child", bad), job("grandchild", job("child", bad)), lucky, job("other"))
    failures = launcher.run(tmp_path, *wanted, attempts=2)
    assert sorted(name for name, _ in launcher.started) == ["bad", "bad", "lucky", "lucky", "other"]
    assert [(f.key.split("-")[1], f.attempts, f.log is None) for f in failures] == [
        ("bad", 2, False), ("child", 0, True), ("grandchild", 0, True),
    ]  # fmt: skip
    assert failures[0].reason == "it was lost"


def test_a_full_queue_is_retried_but_a_refusal_of_the_first_job_ends_the_command(tmp_path: Path) -> None:
    launcher = FakeLauncher(answers=("", "The queue is full.", "The queue is full."))
    assert launcher.run(tmp_path / "a", job("a"), job("b"), jobs=2) == []
    assert [name for name, _ in launcher.started] == ["a", "b"]
    with pytest.raises(SubmissionError, match="No such partition"):
        FakeLauncher(answers=["No such partition."]).run(tmp_path / "b", job("a"))


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit), (signal.SIGHUP, SystemExit)]
)
def test_a_signal_stops_all_jobs_at_a_checkpoint_and_a_second_one_at_once(
    tmp_path: Path, number: signal.Signals, error: type[BaseException]
) -> None:
    launcher = FakeLauncher()
    launcher.at_look = lambda: signal.raise_signal(number) if len(launcher.stopped) < 4 else None
    with pytest.raises(error):
        launcher.run(tmp_path, job("a"), job("b"), job("c", job("a")), jobs=2)
    assert launcher.stopped == [(name, at_once) for at_once in (False, True) for name in "ab"]


def test_a_job_has_its_whole_command(tmp_path: Path) -> None:
    data = Job("dataset", "d", ("collect", "walker", "--out", "{out}"), {})
    trained = Job("encoder", "e", ("pretrain", f"{{{data.key}}}/walker", "--out", "{out}"), {}, (data,))
    describe(tmp_path, make_plan([trained], tmp_path))
    root = str(tmp_path)
    assert Work(root, data.key, workers=3, plugins=("p.py",)).arguments() == [
        "collect", "walker", "--out", f"{root}/jobs/{data.key}", "--plugin", "p.py", "--workers", "3",
    ]  # fmt: skip
    assert Work(root, trained.key, device="cuda").arguments() == [
        "pretrain", f"{root}/jobs/{data.key}/walker", "--out", f"{root}/jobs/{trained.key}", "--device", "cuda",
    ]  # fmt: skip


@pytest.mark.parametrize(("ending", "reason"), [
    (SystemExit(1), "the encoder is missing"), (RuntimeError("shapes differ"), "RuntimeError: shapes differ"),
    (None, ""),
])  # fmt: skip
def test_an_attempt_says_in_its_log_why_it_failed_and_the_time_of_earlier_ones_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: BaseException | None, reason: str
) -> None:
    def command() -> None:
        print("error: the encoder is missing", file=sys.stderr)
        if ending is not None:
            raise ending

    monkeypatch.setattr(sys, "argv", sys.argv)
    wanted, earlier = job("a"), time.time() - 1_000
    describe(tmp_path, make_plan([wanted], tmp_path))
    directory = tmp_path / "jobs" / wanted.key
    write_json(directory / "clock.json", {"seconds": 100.0, "attempts": 2, "began": earlier})
    (directory / "train.csv").touch()
    for name, at in (("train.csv", earlier + 50), ("clock.json", earlier), ("job.json", earlier)):
        os.utime(directory / name, (at, at))
    log = open(directory / "log.txt", "w", buffering=1)  # noqa: SIM115
    with log, redirect_stdout(log), redirect_stderr(log):
        assert Work(str(tmp_path), wanted.key).run(command) == reason
    last = (directory / "log.txt").read_text().splitlines()[-1]
    assert last == (f"error: {reason}" if reason else "finished")
    if reason:
        assert read_json(directory / "clock.json")["attempts"] == 3
    else:
        done = read_json(directory / "done.json")
        assert {*done} == {"seconds", "attempts", "device", "threads", "versions", "hardware", "git_revision"}
        assert done["attempts"] == 3
        assert 150 <= done["seconds"] < 200


def test_two_commands_on_one_root_do_not_run_a_job_twice(tmp_path: Path) -> None:
    wanted = job("a")
    describe(tmp_path, make_plan([wanted], tmp_path))
    directory = tmp_path / "jobs" / wanted.key
    other = FileLock(directory / ".job.lock", thread_local=False)
    other.acquire()

    def finish() -> None:
        write_json(directory / "done.json", {})
        other.release()

    threading.Timer(0.3, finish).start()
    assert Work(str(tmp_path), wanted.key).run(lambda: pytest.fail("it ran twice")) == ""


# --- resources ------------------------------------------------------------------------------------------------------


def test_a_machine_is_divided_among_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "cpu_cores", lambda: 8)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)

    def divided(launcher: str = "local", device: str = "cpu", **given: Any) -> tuple:
        return launch.divide(launcher, device=device, **{"jobs": None, "cores": None, **given})

    assert divided() == (8, 1, ())
    assert divided(jobs=3) == (3, 2, ())
    assert divided(cores=4) == (2, 4, ())
    assert divided(device="cuda", jobs_per_gpu=2) == (4, 2, ("0", "1"))
    assert divided(device="cuda:1") == (1, 8, ())
    assert divided("slurm") == (16, 1, ())
    assert divided("ray", "cuda", jobs=5) == (5, 4, ())
    assert divided(device="cuda", jobs=3) == (2, 4, ("0", "1"))  # more would not find room


def test_gpus_are_shared_evenly_and_jobs_have_their_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = Mock(return_value=Mock(poll=Mock(return_value=None)))
    monkeypatch.setattr(subprocess, "Popen", started)
    monkeypatch.setattr(launch, "free_bytes", lambda _: 8_000)
    launcher = launch.LocalLauncher(("0", "1"), jobs=4)
    for name in "abcd":
        describe(tmp_path, make_plan([job(name)], tmp_path))
        launcher.start(Work(str(tmp_path), job(name).key, threads=3), is_exclusive=False)
    environments = [call.kwargs["env"] for call in started.call_args_list]
    assert sorted(each["CUDA_VISIBLE_DEVICES"] for each in environments) == ["0", "0", "1", "1"]
    assert {each["OMP_NUM_THREADS"] for each in environments} == {"3"}
    assert {(each["CRPTPRO_JOB_BYTES"], each["CRPTPRO_JOBS_PER_GPU"]) for each in environments} == {("2000", "2")}


def test_a_slurm_job_requests_its_cores_and_a_refusal_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("sbatch", "srun", "scancel"):
        (folder / name).write_text("#!/bin/sh\necho Submitted batch job 12\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    asked: dict[str, Any] = {"partition": None, "hours": 1 / 12, "memory_gb": 2.0, "sbatch": ("--qos=high",)}
    launcher = SlurmLauncher(launch.slurm_parameters(**asked, has_gpu=True))
    work = Work(str(tmp_path), "key", threads=4)
    launcher.start(work, is_exclusive=True)
    [script] = (tmp_path / "submitted").rglob("12_submission.sh")
    lines = script.read_text().splitlines()
    for option in ("cpus-per-task=4", "time=5", "mem=2048M", "exclusive", "gpus-per-node=1", "qos=high"):
        assert f"#SBATCH --{option}" in lines
    assert {"export OMP_NUM_THREADS=4", "export SRUN_CPUS_PER_TASK=4"} <= set(lines)
    (folder / "sbatch").write_text("#!/bin/sh\necho Invalid partition >&2\nexit 1\n")
    with pytest.raises(SubmissionError, match=r"sbatch refused a job: .*Change --partition"):
        launcher.start(work, is_exclusive=False)


# --- real processes -------------------------------------------------------------------------------------------------


def _collected(root: Path) -> int:
    return sum(read_json(path)["episodes"] for path in root.glob("jobs/dataset-*/*/card.json"))


@pytest.mark.usefixtures("plugins_are_forgotten")
def test_a_command_that_is_killed_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "root"
    plugin = Path(__file__).parents[1] / "cli" / "slow_env.py"
    words = ("reproduce", "slow", "--scale", "tiny", "--jobs", 1, "--cores-per-job", 1, "--out", root)
    arguments = ["--plugin", *map(str, (plugin, *words))]
    command = subprocess.Popen([sys.executable, "-m", "crptpro", *arguments], start_new_session=True)
    deadline = time.monotonic() + 300
    while _collected(root) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    processes = psutil.Process(command.pid).children(recursive=True)
    assert processes
    os.killpg(command.pid, signal.SIGKILL)
    command.wait()
    assert not psutil.wait_procs(processes, timeout=60)[1]
    assert 2 <= _collected(root) < 8
    assert not list(root.glob("jobs/*/done.json"))

    monkeypatch.setattr(sys, "argv", ["crptpro", *arguments])
    main()
    assert "Everything requested is finished" in capsys.readouterr().out
    [done] = root.glob("jobs/*/done.json")
    assert read_json(done)["attempts"] == 2
    [log] = root.glob("jobs/dataset-*/log.txt")
    assert "continuing after" in log.read_text()  # what the first had collected was kept


def test_a_slurm_job_runs_as_submitit_runs_it(tmp_path: Path) -> None:
    launcher = SlurmLauncher({"timeout_min": 60}, cluster="local")
    assert run_jobs(make_plan([UNTRAINED], tmp_path), tmp_path, launcher, attempts=1) == []
    assert (tmp_path / "jobs" / UNTRAINED.key / "encoder" / "weights.safetensors").exists()
    assert read_json(tmp_path / "jobs" / UNTRAINED.key / "done.json")["threads"] == 1
    assert not list((tmp_path / "submitted").iterdir())


def test_ray_runs_jobs_and_one_whose_worker_died_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "local")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    ray = pytest.importorskip("ray")
    begun, plugin = tmp_path / "begun", tmp_path / "kills_its_worker.py"
    kill = f"os.kill(os.getppid(), {signal.SIGKILL:d})"
    plugin.write_text(f"import os\nif not os.path.exists({str(begun)!r}):\n    open({str(begun)!r}, 'w')\n    {kill}")
    monkeypatch.setattr(plugins, "_loaded", [str(plugin)])
    try:
        assert run_jobs(make_plan([UNTRAINED], tmp_path), tmp_path, RayLauncher(), attempts=2) == []
    finally:
        ray.shutdown()
    assert begun.exists()
    assert (tmp_path / "jobs" / UNTRAINED.key / "encoder" / "weights.safetensors").exists()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1"])
def test_a_missing_ray_cluster_is_reported_in_one_line(address: str) -> None:
    pytest.importorskip("ray")
    with pytest.raises(CRPTproError, match=rf"{address} cannot be used: .*refused.*--ray-address"):
        RayLauncher(address)

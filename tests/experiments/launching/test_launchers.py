"""Real jobs, in this process and in submitit's, and how cores and GPUs are divided among them."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from fake_pieces import PLUGIN, FakePiece, attempts, plan_of

from crptpro.cards import write_json
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CRPTproError, RenderingError, WorkerLostError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import (
    InlineLauncher,
    Outcome,
    Resources,
    SlurmRequest,
    Work,
    divide,
    make_launcher,
    run_pieces,
    threads_alone,
)
from crptpro.experiments.launching.submitted import FOLDER, LocalLauncher
from crptpro.experiments.store import DONE, Store

SETTINGS = JobSettings(plugins=(PLUGIN,))


def test_inline_makes_pieces_in_order_and_keeps_logs(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    data = FakePiece("data")
    refused, broken = FakePiece("refused", (data,), ends="refusal"), FakePiece("broken", ends="defect")
    plan = plan_of(store, refused, broken, FakePiece("well", (data,)))
    failures = run_pieces(plan, store, SETTINGS, InlineLauncher())
    assert {f.piece.title: f.reason for f in failures} == {
        "refused": "refused will never do.", "broken": "RuntimeError: broken is broken",
    }  # fmt: skip
    assert [f.attempts for f in failures] == [1, 1]
    assert "error: refused will never do." in store.log(refused).read_text()
    assert store.log(data).read_text().endswith("finished\n")
    assert store.is_done(FakePiece("well", (data,)))


def test_inline_leaves_the_logging_of_this_process_as_it_was(store: Store) -> None:
    before = list(logging.getLogger("crptpro").handlers)
    run_pieces(plan_of(store, FakePiece("p")), store, SETTINGS, InlineLauncher())
    assert logging.getLogger("crptpro").handlers == before


@pytest.mark.slow
def test_local_jobs_make_pieces_try_again_what_was_killed_and_keep_logs(
    store: Store, source_path: None
) -> None:
    killed = FakePiece("killed", ticks=10, ends="killed")
    refused, broken = FakePiece("refused", ends="refusal"), FakePiece("broken", ends="defect")
    plan = plan_of(store, killed, refused, broken, FakePiece("after", (refused,)))
    settings = JobSettings(threads=3, plugins=(PLUGIN,))
    failures = run_pieces(plan, store, settings, LocalLauncher(), jobs=2, attempts=2)

    assert store.is_done(killed)
    first, second = attempts(store, killed)
    assert (first["from"], second["from"]) == ("0", "5")  # lost is only what came after the checkpoint
    assert first["threads"] == "3"
    assert first["pid"] != str(os.getpid())
    log = store.log(killed).read_text()
    assert log.count("---") == 2
    assert "killed counts on from 5" in log

    found = {failure.piece.title: failure for failure in failures}
    assert set(found) == {"refused", "broken", "after"}
    assert (found["refused"].attempts, found["refused"].reason) == (1, "refused will never do.")
    assert (found["broken"].attempts, found["broken"].reason) == (2, "RuntimeError: broken is broken")
    assert found["after"].is_skipped
    assert "RuntimeError: broken is broken" in store.log(broken).read_text()
    assert not list((store.root / FOLDER).iterdir())


@pytest.mark.parametrize("kind", [RenderingError, WorkerLostError])
def test_what_a_machine_may_do_better_another_time_is_tried_again(
    store: Store, monkeypatch: pytest.MonkeyPatch, kind: type[CRPTproError]
) -> None:
    def fail(*_: object) -> None:
        raise kind("A collecting process was killed by signal 9.")

    piece = FakePiece("p")
    store.describe(piece)
    monkeypatch.setattr("crptpro.experiments.launching.work.build", fail)
    with pytest.raises(kind):  # what is final is returned
        Work(str(store.root), piece.key, SETTINGS).run()


def test_a_job_waits_for_the_one_that_it_replaces(store: Store) -> None:
    piece = FakePiece("slow-to-end")
    store.describe(piece)
    lock = DirectoryLock(store.path(piece))
    release = threading.Timer(1.0, lock.release)
    release.start()
    assert run_pieces(plan_of(store, piece), store, SETTINGS, InlineLauncher()) == []


def test_what_another_process_finishes_meanwhile_is_not_made_again(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    piece = FakePiece("shared")
    store.describe(piece)
    plan = plan_of(store, piece)
    lock = DirectoryLock(store.path(piece))

    def finish() -> None:
        write_json(store.path(piece) / DONE, {})
        for output in store.outputs(piece):
            output.touch()
        lock.release()

    threading.Timer(1.0, finish).start()
    assert run_pieces(plan, store, SETTINGS, InlineLauncher()) == []
    assert attempts(store, piece) == []
    assert caplog.text.count("Another process is making") == 1


def test_a_job_that_waits_for_another_process_can_be_stopped(store: Store) -> None:
    piece = FakePiece("in-use")
    store.describe(piece)
    with DirectoryLock(store.path(piece)):
        stopper = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
        stopper.start()
        with pytest.raises(KeyboardInterrupt):
            run_pieces(plan_of(store, piece), store, SETTINGS, InlineLauncher())


def test_local_jobs_share_gpus_evenly(
    store: Store, source_path: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    class Executor:
        def __init__(self, folder: Path) -> None: ...

        def update_parameters(self, **parameters: object) -> None: ...

        def submit(self, function: object) -> object:
            seen.append(function.work.gpus)  # type: ignore[attr-defined]
            return type("Job", (), {})()

    monkeypatch.setattr("submitit.local.local.LocalExecutor", Executor)
    launcher = LocalLauncher(("4", "GPU-b"))
    jobs = [launcher.start(Work(str(store.root), f"p{i}", SETTINGS), is_exclusive=False) for i in range(4)]
    assert seen == ["4", "GPU-b", "4", "GPU-b"]
    jobs[1].outcome = Outcome()
    launcher.start(Work(str(store.root), "p4", SETTINGS), is_exclusive=False)
    assert seen[-1] == "GPU-b"


# --- what is missing, and how cores are divided -------------------------------------------------------------------


@pytest.mark.parametrize(("launcher", "module", "extra"), [
    ("local", "submitit", "launch"), ("slurm", "submitit", "launch"), ("ray", "ray", "ray"),
])  # fmt: skip
def test_a_missing_extra_names_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, launcher: str, module: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(CRPTproError, match=rf"pip install 'crptpro\[{extra}\]'"):
        make_launcher(launcher, Resources(1, 1))  # type: ignore[arg-type]


@pytest.mark.parametrize(("asked", "expected"), [
    ({}, Resources(8, 1)),
    ({"jobs": 2}, Resources(2, 4)),
    ({"jobs": 3}, Resources(3, 2)),
    ({"jobs": 20}, Resources(20, 1)),
    ({"cores_per_job": 4}, Resources(2, 4)),
    ({"jobs": 1, "cores_per_job": 3}, Resources(1, 3)),
])  # fmt: skip
def test_cores_of_this_machine_are_divided_among_jobs(
    monkeypatch: pytest.MonkeyPatch, asked: dict[str, int], expected: Resources
) -> None:
    monkeypatch.setattr("crptpro.experiments.launching.choice.cpu_cores", lambda: 8)
    assert divide("local", **asked) == expected  # type: ignore[arg-type]


def test_jobs_share_the_gpus_that_this_process_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("crptpro.experiments.launching.choice.cpu_cores", lambda: 16)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,GPU-c")
    assert divide("local", device="cuda") == Resources(2, 8, ("2", "GPU-c"))
    assert divide("local", device="cuda", jobs_per_gpu=4) == Resources(8, 2, ("2", "GPU-c"), 4)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert divide("local", device="cuda").gpus == ("0", "1")
    assert divide("local", device="cuda", jobs=3, jobs_per_gpu=2) == Resources(3, 5, ("0", "1"), 2)
    assert divide("local", device="cuda:1", jobs=2, jobs_per_gpu=2).gpus == ()
    assert divide("local", device="cuda:1") == Resources(1, 16)
    assert divide("local", device="cuda:1", jobs_per_gpu=4) == Resources(4, 4, (), 4)


@pytest.mark.parametrize(("asked", "message"), [
    ({"device": "cuda", "jobs": 5, "jobs_per_gpu": 2}, "--jobs 5 are more than 2 GPUs take with --jobs-per-gpu 2: "
     "ask for --jobs 4, or let more share a GPU with --jobs-per-gpu 3."),
    ({"device": "cuda:1", "jobs": 4}, "--jobs 4 are more than 1 GPU takes with --jobs-per-gpu 1: "
     "ask for --jobs 1, or let more share a GPU with --jobs-per-gpu 4."),
])  # fmt: skip
def test_more_jobs_than_the_gpus_of_this_machine_take_are_refused(
    monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], message: str
) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    with pytest.raises(CRPTproError) as refusal:
        divide("local", **asked)
    assert str(refusal.value) == message
    assert divide("ray", **asked).jobs == asked["jobs"]


def test_a_piece_that_is_alone_has_the_threads_of_all_jobs_of_one_machine() -> None:
    assert threads_alone("local", Resources(3, 2)) == 6
    assert threads_alone("slurm", Resources(3, 2)) == 2


def test_without_a_gpu_cuda_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    with pytest.raises(CRPTproError, match="no GPU"):
        divide("local", device="cuda")


def test_a_number_below_one_is_refused() -> None:
    with pytest.raises(CRPTproError, match="--jobs must be at least 1, got 0"):
        divide("local", jobs=0)


def test_an_option_of_sbatch_that_says_nothing_is_refused() -> None:
    with pytest.raises(CRPTproError, match="write key=value"):
        SlurmRequest(sbatch=("qos",))


@pytest.mark.parametrize("option", ["cpus-per-task=4", "--cpus_per_task=4", "mem=4G", "time=10"])
def test_an_option_of_sbatch_that_has_one_of_its_own_is_refused(option: str) -> None:
    with pytest.raises(CRPTproError, match=r"say it by --(cores-per-job|memory-gb|hours)"):
        SlurmRequest(sbatch=(option,))

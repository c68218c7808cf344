"""Real jobs: in this process, in submitit's, and what is asked of Slurm."""

from __future__ import annotations

import logging
import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from fake_pieces import PLUGIN, FakePiece, attempts, counted, plan_of

from crptpro.cards import write_json
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CRPTproError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import (
    InlineLauncher,
    Launcher,
    Outcome,
    Resources,
    SlurmRequest,
    Work,
    divide,
    make_launcher,
    run_pieces,
    threads_alone,
)
from crptpro.experiments.launching.submitted import FOLDER, LocalLauncher, SlurmLauncher
from crptpro.experiments.store import DONE, Store

SETTINGS = JobSettings(plugins=(PLUGIN,))


def when(condition: Callable[[], object], then: Callable[[], object]) -> threading.Thread:
    """Do something in another thread as soon as something holds."""

    def watch() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            if condition():
                then()
                return
            time.sleep(0.02)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


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


# --- Slurm, played by four scripts --------------------------------------------------------------------------------

SBATCH = """#!/bin/bash
id=$(($(ls "$FAKE_SLURM" | wc -l) + 100))
cp "$1" "$FAKE_SLURM/$id.sh"
SLURM_JOB_ID=$id setsid bash "$FAKE_SLURM/run" $id > "$FAKE_SLURM/$id.out" 2>&1 < /dev/null &
echo "Submitted batch job $id"
"""
RUN = """
while true; do
  rm -f "$FAKE_SLURM/$1.again"
  bash "$FAKE_SLURM/$1.sh"
  [ -e "$FAKE_SLURM/$1.again" ] || break
done
touch "$FAKE_SLURM/$1.ended"
"""
SRUN = """#!/bin/bash
while [[ $1 == --* ]]; do
  case $1 in --output|--error) shift 2;; *) shift;; esac
done
export SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0 SLURM_PROCID=0 SLURM_LOCALID=0
exec "$@"
"""
SACCT = """#!/bin/bash
echo "JobID|State|NodeList"
for file in "$FAKE_SLURM"/*.sh; do
  id=$(basename "$file" .sh)
  if [ -e "$FAKE_SLURM/$id.ended" ]; then echo "$id|NODE_FAIL|n1"; else echo "$id|RUNNING|n1"; fi
done
"""
SCONTROL = """#!/bin/bash
touch "$FAKE_SLURM/$2.again"
"""


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source_path: None) -> Path:
    """A directory with one script per job that was queued."""
    programs, state = tmp_path / "bin", tmp_path / "slurm"
    programs.mkdir()
    state.mkdir()
    (state / "run").write_text(RUN)
    for name, text in {"sbatch": SBATCH, "srun": SRUN, "sacct": SACCT, "scontrol": SCONTROL}.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755 | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(state))
    return state


def slurm_launcher(**request: object) -> Launcher:
    resources = divide("slurm", device=str(request.pop("device", "cpu")), cores_per_job=2)
    device = "cuda" if request.pop("gpu", False) else "cpu"
    return make_launcher("slurm", resources, device=device, slurm=SlurmRequest(**request))  # type: ignore[arg-type]


@pytest.mark.slow
def test_slurm_is_asked_for_what_a_job_needs_and_goes_on_after_its_time_was_up(
    store: Store, slurm: Path
) -> None:
    piece = FakePiece("long", ticks=30)
    launcher = slurm_launcher(partition="short", hours=2, memory_gb=8, sbatch=("qos=high",), gpu=True)
    times_up = when(
        lambda: counted(store, piece) >= 5,
        lambda: os.kill(int(attempts(store, piece)[0]["pid"]), signal.SIGUSR2),
    )
    settings = JobSettings(threads=2, plugins=(PLUGIN,))
    assert run_pieces(plan_of(store, piece), store, settings, launcher) == []
    times_up.join()

    [script] = [path.read_text() for path in slurm.glob("*.sh")]
    for line in (
        f"--job-name={piece.key}", "--partition=short", "--time=120", "--mem=8192M", "--cpus-per-task=2",
        "--gpus-per-node=1", "--qos=high", "--signal=USR2@90",
    ):  # fmt: skip
        assert f"#SBATCH {line}\n" in script
    assert "export OMP_NUM_THREADS=2\n" in script
    first, second = attempts(store, piece)
    assert first["from"] == "0"
    assert int(second["from"]) >= 5
    assert second["threads"] == "2"


def test_an_exclusive_piece_asks_slurm_for_a_node_of_its_own(store: Store, slurm: Path) -> None:
    (slurm.parent / "bin" / "sbatch").write_text(SBATCH.replace("setsid", "true"))
    launcher = slurm_launcher()
    launcher.start(Work(str(store.root), "timing", SETTINGS), is_exclusive=True)
    launcher.start(Work(str(store.root), "other", SETTINGS), is_exclusive=False)
    scripts = [path.read_text() for path in sorted(slurm.glob("*.sh"))]
    assert ["#SBATCH --exclusive\n" in script for script in scripts] == [True, False]
    assert not any("gpus" in script for script in scripts)


def test_a_slurm_job_is_asked_to_write_a_checkpoint_before_it_is_cancelled(store: Store, slurm: Path) -> None:
    programs = slurm.parent / "bin"
    (programs / "sbatch").write_text(SBATCH.replace("setsid", "true"))
    (programs / "scancel").write_text('#!/bin/bash\necho "$*" >> "$FAKE_SLURM/cancelled"\n')
    (programs / "scancel").chmod(0o755)
    job = slurm_launcher().start(Work(str(store.root), "p", SETTINGS), is_exclusive=False)
    [number] = [path.stem for path in slurm.glob("*.sh")]
    job.stop()
    asked = [f"--state=PENDING {number}", f"--signal=TERM {number}"]
    assert (slurm / "cancelled").read_text().splitlines() == asked
    job.stop()
    assert (slurm / "cancelled").read_text().splitlines() == [*asked, number]


def test_what_sbatch_refuses_is_said_in_a_line(store: Store, slurm: Path) -> None:
    (slurm.parent / "bin" / "sbatch").write_text(
        "#!/bin/bash\necho 'sbatch: error: invalid partition specified: shrt' >&2\nexit 1\n"
    )
    with pytest.raises(CRPTproError, match=r"invalid partition specified: shrt.*--partition"):
        slurm_launcher(partition="shrt").start(Work(str(store.root), "p", SETTINGS), is_exclusive=False)


def test_without_slurm_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CRPTproError, match=r"needs sbatch and srun.*--launcher local"):
        SlurmLauncher({})


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
    assert divide("local", device="cuda:1", jobs=2).gpus == ()
    assert divide("local", device="cuda:1") == Resources(1, 16)
    assert divide("local", device="cuda:1", jobs_per_gpu=4) == Resources(4, 4, (), 4)


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

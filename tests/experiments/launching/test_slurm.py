"""Jobs of a Slurm cluster, which four scripts play."""

from __future__ import annotations

import os
import signal
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from fake_pieces import PLUGIN, FakePiece, attempts, counted, plan_of
from submitit.slurm.slurm import SlurmInfoWatcher

from crptpro.errors import CRPTproError, SubmissionError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import (
    Launcher,
    Outcome,
    SlurmRequest,
    Work,
    divide,
    make_launcher,
    run_pieces,
)
from crptpro.experiments.launching.slurm import PREEMPTED_LOOKS, Looks, SlurmJob, SlurmLauncher
from crptpro.experiments.launching.submitted import FOLDER
from crptpro.experiments.store import Store

SETTINGS = JobSettings(plugins=(PLUGIN,))

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
  if [ -e "$FAKE_SLURM/$id.ended" ]; then echo "$id|NODE_FAIL|n1"
  else echo "$id|$(cat "$FAKE_SLURM/$id.state" 2> /dev/null || echo RUNNING)|n1"; fi
done
"""
SCONTROL = """#!/bin/bash
touch "$FAKE_SLURM/$2.again"
"""


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
    # Numbers of jobs come again from test to test, and submitit remembers which have ended.
    monkeypatch.setattr("submitit.slurm.slurm.SlurmJob.watcher", SlurmInfoWatcher(delay_s=600))
    return state


@pytest.fixture
def idle_slurm(slurm: Path) -> Path:
    """Its jobs do nothing, and are in the state that the test writes for them."""
    programs = slurm.parent / "bin"
    (programs / "sbatch").write_text(SBATCH.replace("setsid", "true"))
    (programs / "scancel").write_text('#!/bin/bash\necho "$*" >> "$FAKE_SLURM/cancelled"\n')
    (programs / "scancel").chmod(0o755)
    return slurm


def queue(store: Store, slurm: Path, state: str) -> SlurmJob:
    job = slurm_launcher().start(Work(str(store.root), "p", SETTINGS), is_exclusive=False)
    assert isinstance(job, SlurmJob)
    job.looks.pause_s = 0.0
    job.job._results_timeout_s = 0
    job.work.log.parent.mkdir(parents=True, exist_ok=True)
    set_state(slurm, job, state)
    return job


def set_state(slurm: Path, job: SlurmJob, state: str) -> None:
    (slurm / f"{job.job.job_id}.state").write_text(state)


def leave_alone(job: SlurmJob) -> None:
    """Have submitit believe that no job was queued for hours, and that it has just looked."""
    watcher = job.job.watcher
    watcher._start_time, watcher._last_status_check = time.time() - 10_000, time.time()


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


def test_an_exclusive_piece_asks_slurm_for_a_node_of_its_own(store: Store, idle_slurm: Path) -> None:
    launcher = slurm_launcher()
    launcher.start(Work(str(store.root), "timing", SETTINGS), is_exclusive=True)
    launcher.start(Work(str(store.root), "other", SETTINGS), is_exclusive=False)
    scripts = [path.read_text() for path in sorted(idle_slurm.glob("*.sh"))]
    assert ["#SBATCH --exclusive\n" in script for script in scripts] == [True, False]
    assert not any("gpus" in script for script in scripts)


@pytest.mark.parametrize(("given", "cores"), [({}, 2), ({"cpus_per_task": 6}, 6)])
def test_srun_is_given_the_cores_that_sbatch_was_asked_for(
    store: Store, idle_slurm: Path, given: dict[str, int], cores: int
) -> None:
    launcher = SlurmLauncher({**given, "setup": ["module load cuda", "export OMP_NUM_THREADS=9"]})
    settings = JobSettings(threads=2, plugins=(PLUGIN,))
    launcher.start(Work(str(store.root), "p", settings), is_exclusive=False)
    [script] = [path.read_text() for path in idle_slurm.glob("*.sh")]
    setup = script[script.index("# setup\n") : script.index("# command\n")].splitlines()
    assert f"#SBATCH --cpus-per-task={cores}\n" in script
    assert f"export SRUN_CPUS_PER_TASK={cores}" in setup
    assert setup.index("export OMP_NUM_THREADS=2") < setup.index("module load cuda")
    assert setup.index("export OMP_NUM_THREADS=2") < setup.index("export OMP_NUM_THREADS=9")


def test_a_slurm_job_is_asked_to_write_a_checkpoint_before_it_is_cancelled(
    store: Store, idle_slurm: Path
) -> None:
    slurm = idle_slurm
    job = slurm_launcher().start(Work(str(store.root), "p", SETTINGS), is_exclusive=False)
    [number] = [path.stem for path in slurm.glob("*.sh")]
    job.stop()
    asked = [f"--state=PENDING {number}", f"--signal=TERM {number}"]
    assert (slurm / "cancelled").read_text().splitlines() == asked
    job.stop()
    assert (slurm / "cancelled").read_text().splitlines() == [*asked, number]


def test_a_preempted_job_that_is_not_queued_again_was_lost(store: Store, idle_slurm: Path) -> None:
    jobs = [queue(store, idle_slurm, "PREEMPTED") for _ in range(2)]
    outcomes = [[job.poll() for job in jobs] for _ in range(PREEMPTED_LOOKS + 1)]
    assert outcomes[0] == [None, None]
    assert outcomes[-1] == [Outcome("the job was lost (preempted)")] * 2
    assert not any(job.folder.exists() for job in jobs)


def test_a_preempted_job_that_is_queued_again_goes_on(store: Store, idle_slurm: Path) -> None:
    job = queue(store, idle_slurm, "PREEMPTED")
    for state in ("PREEMPTED", "PENDING") * 3:
        set_state(idle_slurm, job, state)
        job.job.watcher.update()  # submitit ignores a forced look within a millisecond of another
        assert [job.poll() for _ in range(PREEMPTED_LOOKS - 1)] == [None] * (PREEMPTED_LOOKS - 1)


def test_slurm_is_asked_about_all_jobs_at_once_and_not_at_every_poll(store: Store, idle_slurm: Path) -> None:
    jobs = [queue(store, idle_slurm, "PREEMPTED") for _ in range(2)]
    looks = Looks()
    for job in jobs:
        job.looks = looks
        job.poll()
    leave_alone(jobs[0])
    asked = jobs[0].job.watcher.num_calls
    assert [job.poll() for job in jobs * 5] == [None] * 10
    assert jobs[0].job.watcher.num_calls - asked <= 1


def test_the_end_of_a_job_that_was_stopped_is_noticed_without_waiting_for_submitits_next_look(
    store: Store, idle_slurm: Path
) -> None:
    job = queue(store, idle_slurm, "RUNNING")
    assert job.poll() is None
    leave_alone(job)
    set_state(idle_slurm, job, "CANCELLED by 1000")
    assert job.poll() is None
    job.stop()
    assert job.poll() == Outcome("the job was lost (cancelled by 1000)")


def test_what_sbatch_refuses_is_said_in_a_line(store: Store, slurm: Path) -> None:
    (slurm.parent / "bin" / "sbatch").write_text(
        "#!/bin/bash\necho 'sbatch: error: invalid partition specified: shrt' >&2\nexit 1\n"
    )
    with pytest.raises(SubmissionError, match=r"invalid partition specified: shrt.*--partition"):
        slurm_launcher(partition="shrt").start(Work(str(store.root), "p", SETTINGS), is_exclusive=False)
    assert not list((store.root / FOLDER).iterdir())


def test_without_slurm_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CRPTproError, match=r"needs sbatch and srun.*--launcher local"):
        SlurmLauncher({})

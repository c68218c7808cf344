"""Jobs through submitit, wherever they run, and those that are processes of this machine."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crptpro.errors import CRPTproError
from crptpro.experiments.launching.gpus import visible_gpus
from crptpro.experiments.launching.launchers import Outcome
from crptpro.experiments.launching.orphans import leave_with
from crptpro.experiments.launching.work import THREAD_VARIABLES, Work

FOLDER = "jobs"
"""Below ROOT: what submitit keeps of a job while it runs."""

ENDLESS_MINUTES = 60 * 24 * 365


@dataclass(frozen=True)
class SubmittedWork:
    """The function that submitit pickles.

    Args:
        work: what to do.
        scheduler: process of this machine that the job ends with; ``None`` on a cluster, which keeps its own watch.
    """

    work: Work
    scheduler: int | None = None

    def __call__(self) -> str:
        """Make the piece in a process of submitit's."""
        with contextlib.suppress(
            OSError
        ):  # away from the terminal: Ctrl-C is the scheduler's to pass on, once
            os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, _leave)
        if self.scheduler is not None:
            leave_with(self.scheduler)
        return self.work.run_logged()

    def checkpoint(self) -> Any:
        """Have Slurm queue the job again when its time is up; the piece continues from its own checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def _leave(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


@dataclass
class SubmittedJob:
    """A job of submitit's.

    Args:
        job: as submitit knows it.
        folder: that submitit keeps it in; removed when it has ended.
        work: what it does.
    """

    job: Any
    folder: Path
    work: Work
    is_asked_to_stop: bool = field(default=False, init=False)
    outcome: Outcome | None = field(default=None, init=False)

    def poll(self) -> Outcome | None:
        """How it ended, or ``None``."""
        if self.outcome is None and (outcome := self._look()) is not None:
            self.outcome = outcome
            shutil.rmtree(self.folder, ignore_errors=True)
        return self.outcome

    def _look(self) -> Outcome | None:
        return self._read() if self.job.done() else None

    def _read(self) -> Outcome:
        failure = self.job.exception()
        if failure is None:
            refusal = self.job.result()
            return Outcome(refusal, is_final=bool(refusal))
        lines = str(failure).strip().splitlines()
        if type(failure).__name__ != "UncompletedJobError":
            trace = [line for line in lines[:-3] if line.strip(" -")]
            return Outcome(trace[-1].strip() if trace else "it failed")
        return self._lost(str(self.job.state))

    def _lost(self, state: str) -> Outcome:
        said = (self.job.stderr() or "").strip()
        if said:  # it did not get as far as the piece's log, or the system said why it ended the job
            with open(self.work.log, "a") as log:
                log.write(said + "\n")
        return Outcome(f"the job was lost ({state.lower()})")

    def stop(self) -> None:
        """Pass SIGTERM on; the stages write a checkpoint when it arrives, and leave at once at the second."""
        with contextlib.suppress(OSError):
            self.job._process.send_signal(signal.SIGTERM)  # submitit's controller hands it to the job
        self.is_asked_to_stop = True


class LocalLauncher:
    """Processes of this machine.

    Args:
        gpus: one or several, by index or UUID, that jobs share evenly; empty leaves jobs what this process sees.

    Raises:
        CRPTproError: without submitit.
    """

    is_one_machine = True

    def __init__(self, gpus: Sequence[str] = ()) -> None:
        require_submitit("local")
        self.gpus = tuple(gpus)
        self._jobs: list[SubmittedJob] = []

    def start(self, work: Work, *, is_exclusive: bool) -> SubmittedJob:
        """Start a process; the scheduler sees to it that nothing of ours runs beside an exclusive one."""
        from submitit.local.local import LocalExecutor

        self._jobs = [job for job in self._jobs if job.outcome is None]
        # submitit hides all GPUs from a job that asks it for none; the job itself brings them back.
        seen = ",".join(visible_gpus())
        if self.gpus:
            seen = min(self.gpus, key=lambda gpu: sum(job.work.gpus == gpu for job in self._jobs))
        work = Work(work.root, work.key, work.settings, gpus=seen)
        folder = new_folder(work)
        executor = LocalExecutor(folder)
        executor.update_parameters(timeout_min=ENDLESS_MINUTES)
        with _environment_of_jobs(work.settings.threads):
            submitted: Any = executor.submit(SubmittedWork(work, scheduler=os.getpid()))
        submitted._results_timeout_s = 0  # the result is on this machine's disk when the process has ended
        self._jobs.append(SubmittedJob(submitted, folder, work))
        return self._jobs[-1]

    def close(self) -> None:
        """Nothing is held."""


def require_submitit(launcher: str) -> None:
    """Make sure that submitit can be imported.

    Raises:
        CRPTproError: naming the command that installs it.
    """
    try:
        import submitit  # noqa: F401
    except ImportError as reason:
        raise CRPTproError(
            f"--launcher {launcher} needs submitit ({reason}): pip install 'crptpro[launch]', "
            "or choose --launcher inline."
        ) from None


def new_folder(work: Work) -> Path:
    """A directory for one submission: submitit names its files by process ids, which come again."""
    parent = Path(work.root) / FOLDER
    parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f"{work.key}-", dir=parent))


@contextlib.contextmanager
def _environment_of_jobs(threads: int) -> Iterator[None]:
    """What a process that is started inside inherits: numbers of threads, and a deaf ear to Ctrl-C.

    A terminal sends Ctrl-C to every process. submitit's controller would kill its job a second later; the job asks
    for signals itself.
    """
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGINT, handler)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

"""Run the missing jobs of a plan: in processes of this machine, on a Slurm cluster, or on Ray."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import logging
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from filelock import FileLock, Timeout

from crptpro.artifact import read_json, write_json
from crptpro.errors import CRPTproError, RecordError, SubmissionError
from crptpro.experiments.jobs import (
    CLOCK,
    DESCRIPTION,
    DONE,
    LOCK,
    LOG,
    OWN,
    Job,
    Plan,
    describe,
    directory_of,
)
from crptpro.provenance import cpu_cores, provenance

logger = logging.getLogger(__name__)

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""What numpy and torch read when they are loaded."""
LEFTOVERS = {"run": ("checkpoints", "replay")} | dict.fromkeys(
    ("encoder", "explored", "finetuned"), ("checkpoints",)
)
"""Directories that only an unfinished job needs."""
WITH_DEVICE = ("encoder", "explored", "finetuned", "run", "probe", "coverage", "embeddings")
CLUSTER_JOBS, CLUSTER_GPU_CORES = 16, 4
MAX_REQUEUES = 1_000
"""How often a Slurm job is queued again when its time was up. Each time it has got further."""
POLL_S, REFUSED_S, LAST_WAIT_S, SLURM_LOOK_S = 0.2, 60.0, 10.0, 10.0


@dataclass(frozen=True)
class Work:
    """One job to run; all that travels to where it runs. None of it but root and key is part of what the job is.

    Args:
        root: of the reproduction, absolute.
        key: of the job, which is described there.
        device: of networks.
        threads: of torch.
        workers: processes of a job that collects.
        plugins: modules that are loaded first, for methods and domains of the user's own.
    """

    root: str
    key: str
    device: str = "cpu"
    threads: int = 1
    workers: int = 1
    plugins: tuple[str, ...] = ()

    @property
    def directory(self) -> Path:
        """Where the job lies."""
        return directory_of(Path(self.root), self.key)

    def arguments(self) -> list[str]:
        """Return the whole command line of the job after ``crptpro``."""
        content = read_json(self.directory / DESCRIPTION, error=RecordError)
        places = {f"{{{key}}}": str(directory_of(Path(self.root), key)) for key in content["needs"]}
        places[OWN] = str(self.directory)
        words = content["command"]
        for mark, path in places.items():
            words = [word.replace(mark, path) for word in words]
        words += [part for plugin in self.plugins for part in ("--plugin", plugin)]
        if content["kind"] == "dataset":
            words += ["--workers", str(self.workers)]
        return words + (["--device", self.device] if content["kind"] in WITH_DEVICE else [])

    def run(self) -> str:
        """Run the job in this process, or continue it, unless another process has finished it meanwhile.

        Returns:
            Why it is not finished; empty if it is.
        """
        now = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
        where = f"{socket.gethostname()}, process {os.getpid()}, {self.device}, {self.threads} threads"
        print(f"--- {now}: {where}", flush=True)
        with _locked(self.directory):
            if (self.directory / DONE).exists():
                return ""
            torch.set_num_threads(self.threads)
            clock = _clock(self.directory)
            reason = _command(self.arguments(), self.directory / LOG)
            if not reason:
                seconds = clock["seconds"] + time.time() - clock["began"]
                how = {"device": self.device, "threads": self.threads, "attempts": clock["attempts"]}
                write_json(self.directory / DONE, {"seconds": seconds, **how, **provenance()})
                (self.directory / CLOCK).unlink(missing_ok=True)
                for name in LEFTOVERS.get(self.key.split("-")[0], ()):
                    shutil.rmtree(self.directory / name, ignore_errors=True)
        print(f"error: {reason}" if reason else "finished", flush=True)
        return reason

    def run_alone(self) -> str:
        """Do the same in a process that has nothing else to do: all that it prints goes to the job's log."""
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, _leave)
        with _output_to(self.directory / LOG):
            return self.run()


def _leave(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Hold a job; another command, or the job of a killed one that runs to its next checkpoint, may hold it first."""
    lock = FileLock(directory / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        logger.warning("Another process runs %s; waiting until it ends.", directory.name)
        lock.acquire(timeout=1e9, poll_interval=1)
    try:
        yield
    finally:
        lock.release()


def _clock(directory: Path) -> dict[str, float]:
    """Begin an attempt; one that was killed lasted until the last change of a file of the job."""
    before: dict[str, Any] = {"seconds": 0.0, "attempts": 0}
    with contextlib.suppress(RecordError):
        before = read_json(directory / CLOCK, error=RecordError)
        last = max(path.stat().st_mtime for path in directory.iterdir() if path.name not in (LOCK, LOG))
        before["seconds"] += max(0.0, last - before["began"])
    clock = {"seconds": before["seconds"], "attempts": before["attempts"] + 1, "began": time.time()}
    write_json(directory / CLOCK, clock)
    return clock


def _command(arguments: Sequence[str], log: Path) -> str:
    """Call ``crptpro`` and return what went wrong."""
    from crptpro.cli import main

    before, sys.argv = sys.argv, ["crptpro", *arguments]
    try:
        main()
    except SystemExit as end:
        if end.code in (130, 143):  # it was stopped
            raise
        return "" if not end.code else _last_line(log).removeprefix("error: ")
    except Exception as error:  # a defect keeps its traceback
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    finally:
        sys.argv = before
    return ""


def _last_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    words = (line.strip(" │╭╮╰╯─") for line in reversed(lines))  # without the frame of a usage message
    return next(filter(None, words), "")


@contextlib.contextmanager
def _output_to(path: Path) -> Iterator[None]:
    """Append standard output and error to a file, those of child processes too."""
    kept, before = [os.dup(number) for number in (1, 2)], (sys.stdout, sys.stderr)
    with open(path, "ab") as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)
    # What stands in for the streams may write elsewhere: Ray's copies go to its own files.
    sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1, closefd=False, encoding="utf-8") for n in (1, 2))
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before
        for number, copy in zip((1, 2), kept):
            os.dup2(copy, number)
            os.close(copy)


# --- where jobs run -------------------------------------------------------------------------------------------------


class Handle(Protocol):
    """A job that was started: ``poll`` is ``None`` while it runs or is queued, then why it was lost, or nothing."""

    def poll(self) -> str | None: ...  # noqa: D102

    def stop(self) -> None: ...  # noqa: D102 - ask it to write a checkpoint and end; asked again, to end at once


class Launcher(Protocol):
    """A place where jobs run; a queue that does not take one now raises ``SubmissionError``."""

    is_one_machine: bool
    """Whether all jobs share this machine's cores."""

    def start(self, work: Work, *, is_exclusive: bool) -> Handle: ...  # noqa: D102


@dataclass
class _Process:
    process: subprocess.Popen
    gpu: str | None

    def poll(self) -> str | None:
        status = self.process.poll()
        if status is None:
            return None
        return f"its process was ended by {signal.Signals(-status).name}" if status < 0 else ""

    def stop(self) -> None:
        with contextlib.suppress(OSError):
            self.process.send_signal(signal.SIGTERM)


class LocalLauncher:
    """Processes of this machine.

    Args:
        gpus: that jobs share evenly, by index or UUID; without any, jobs see what this process sees.
    """

    is_one_machine = True

    def __init__(self, gpus: Sequence[str] = ()) -> None:
        self.gpus, self._running = tuple(gpus), list[_Process]()

    def start(self, work: Work, *, is_exclusive: bool) -> Handle:
        """Start a process that ends with this one; Ctrl-C in the terminal does not reach it."""
        self._running = [each for each in self._running if each.poll() is None]
        environment, gpu = os.environ | dict.fromkeys(THREAD_VARIABLES, str(work.threads)), None
        if self.gpus:
            gpu = min(self.gpus, key=lambda name: sum(each.gpu == name for each in self._running))
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        order = json.dumps(dataclasses.asdict(work))
        command = [sys.executable, "-m", "crptpro.experiments.launch", order, str(os.getpid())]
        with open(work.directory / LOG, "ab") as log:
            process = subprocess.Popen(
                command, env=environment, start_new_session=True, stdout=log, stderr=log
            )
        self._running.append(_Process(process, gpu))
        return self._running[-1]


@dataclass(frozen=True)
class _Submitted:
    """The function that submitit pickles."""

    work: Work

    def __call__(self) -> str:
        with contextlib.suppress(OSError):  # Ctrl-C is the command's to pass on
            os.setsid()
        return self.work.run_alone()

    def checkpoint(self) -> Any:
        """Have Slurm queue the job again when its time is up; it continues from its own checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


@dataclass
class _SlurmJob:
    job: Any
    folder: Path
    log: Path
    is_stopping: bool = False
    looked: float = -math.inf

    def poll(self) -> str | None:
        # Left alone, submitit asks Slurm every ten minutes.
        is_due = self.is_stopping and time.monotonic() - self.looked > SLURM_LOOK_S
        self.looked = time.monotonic() if is_due else self.looked
        if not self.job.done(force_check=is_due):
            return None
        reason = ""
        if type(self.job.exception()).__name__ == "UncompletedJobError":
            reason = f"the job was lost ({str(self.job.state).lower()})"
            with open(self.log, "a", encoding="utf-8") as log:  # it may not have got as far as its log
                log.write((self.job.stderr() or "").strip() + "\n")
        shutil.rmtree(self.folder, ignore_errors=True)
        return reason

    def stop(self) -> None:
        for options in [[]] if self.is_stopping else [["--state=PENDING"], ["--signal=TERM"]]:
            with contextlib.suppress(OSError):
                subprocess.call(["scancel", *options, self.job.job_id])
        self.is_stopping = True


class SlurmLauncher:
    """A Slurm cluster, whose nodes share ROOT and the environment of this process.

    Args:
        parameters: of submitit's executor.
        cluster: submitit's name of it; tests have ``"local"``.

    Raises:
        CRPTproError: without submitit, or where there is no Slurm.
    """

    is_one_machine = False

    def __init__(self, parameters: Mapping[str, Any], cluster: str = "slurm") -> None:
        try:
            import submitit  # noqa: F401
        except ImportError as reason:
            raise CRPTproError(
                f"--launcher slurm needs submitit ({reason}): pip install 'crptpro[launch]', or choose another one."
            ) from None
        if cluster == "slurm" and (shutil.which("srun") is None or shutil.which("sbatch") is None):
            raise CRPTproError(
                "--launcher slurm needs sbatch and srun, which are not here: call it on a login node of the cluster, "
                "or choose --launcher local."
            )
        self.parameters, self.cluster = dict(parameters), cluster

    def start(self, work: Work, *, is_exclusive: bool) -> Handle:
        """Queue a job; an exclusive one asks for a node of its own."""
        from submitit import AutoExecutor
        from submitit.core.utils import FailedJobError

        parent = Path(work.root) / "submitted"
        parent.mkdir(exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{work.key}-", dir=parent))
        executor = AutoExecutor(folder, cluster=self.cluster, slurm_max_num_timeout=MAX_REQUEUES)
        executor.update_parameters(**self.job_parameters(work, is_exclusive=is_exclusive))
        try:
            return _SlurmJob(executor.submit(_Submitted(work)), folder, work.directory / LOG)
        except FailedJobError as reason:
            shutil.rmtree(folder, ignore_errors=True)
            said = (str(reason).strip().splitlines() or ["it gave no reason"])[-1]
            raise SubmissionError(
                f"sbatch refused a job: {said} Change --partition, --hours or --sbatch."
            ) from reason

    def job_parameters(self, work: Work, *, is_exclusive: bool) -> dict[str, Any]:
        """Return what submitit is told of one job."""
        # Since Slurm 22.05 srun does not ask for the cores that sbatch was given, and would run the job on one.
        setup = [f"export {name}={work.threads}" for name in (*THREAD_VARIABLES, "SRUN_CPUS_PER_TASK")]
        own = {"job_name": work.key, "cpus_per_task": work.threads, "setup": setup, "exclusive": is_exclusive}
        return {f"slurm_{name}": value for name, value in {**own, **self.parameters}.items() if value}


@dataclass
class _RayJob:
    ray: Any
    task: Any
    is_stopping: bool = field(default=False, init=False)

    def poll(self) -> str | None:
        if not self.ray.wait([self.task], timeout=0)[0]:
            return None
        try:
            self.ray.get(self.task)
        except self.ray.exceptions.RayTaskError:
            return ""
        except self.ray.exceptions.RayError as reason:  # its worker or its node is gone, or it was stopped
            return f"the job was lost ({type(reason).__name__})"
        return ""

    def stop(self) -> None:
        self.ray.cancel(self.task, force=self.is_stopping)
        self.is_stopping = True


class RayLauncher:
    """A Ray cluster whose nodes share ROOT; without one, Ray on this machine.

    Args:
        address: of the cluster's head; ``None`` for ``RAY_ADDRESS``, a cluster that runs here, or a new one.
        cores: of each job.
        gpus: of each job, a whole number or a fraction of one.

    Raises:
        CRPTproError: without Ray, or if the cluster cannot be reached.
    """

    is_one_machine = False

    def __init__(self, address: str | None = None, *, cores: int = 1, gpus: float = 0) -> None:
        try:
            import ray
        except ImportError as reason:
            raise CRPTproError(
                f"--launcher ray needs Ray ({reason}): pip install 'crptpro[ray]', or choose --launcher local."
            ) from None
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        address = address or os.environ.get("RAY_ADDRESS") or None
        try:
            host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
            if colon and port.isdigit():  # Ray itself would ask for minutes where nobody listens
                socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
            try:
                ray.init(address=address or "auto", **options)
            except ConnectionError:
                if address is not None:
                    raise
                ray.init(address="local", include_dashboard=False, **options)
        except (OSError, RuntimeError, ValueError) as reason:
            said = (str(reason).strip().splitlines() or [type(reason).__name__])[0]
            raise CRPTproError(
                f"The Ray cluster {address or 'of this machine'} cannot be used: {said}. Give the address that "
                "`ray start --head` printed, as --ray-address HOST:6379, or ray://HOST:10001."
            ) from reason
        sizes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(size.get("CPU", 0) >= cores and size.get("GPU", 0) >= gpus for size in sizes):
            asked = f"{cores} cores and {gpus:g} GPUs"
            logger.warning(
                "No node of the Ray cluster has the %s that a job asks for: jobs wait for one.", asked
            )
        self._ray, self._gpus = ray, gpus
        # A worker ends with its job, as a process of its own would: nothing of a job is left for the next.
        self._run = ray.remote(max_retries=0, max_calls=1)(_run_alone)

    def start(self, work: Work, *, is_exclusive: bool) -> Handle:
        """Queue a job; Ray starts it where cores and GPUs are free."""
        variables = dict.fromkeys(THREAD_VARIABLES, str(work.threads))
        task = self._run.options(
            name=work.key, num_cpus=work.threads, num_gpus=self._gpus, runtime_env={"env_vars": variables}
        ).remote(work)
        return _RayJob(self._ray, task)


def _run_alone(work: Work) -> str:
    return work.run_alone()


# --- which jobs, when -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure:
    """A job that is not finished; without a ``log`` it was not started, since something that it needs failed."""

    key: str
    reason: str
    log: Path | None = None
    attempts: int = 0


def run_jobs(
    plan: Plan,
    root: Path,
    launcher: Launcher,
    *,
    jobs: int = 1,
    cores: int = 1,
    device: str = "cpu",
    plugins: tuple[str, ...] = (),
    attempts: int = 3,
) -> list[Failure]:
    """Run every missing job of a plan as soon as all that it needs is finished.

    A job that must be alone on its machine starts when nothing else can. Ctrl-C, SIGTERM and SIGHUP stop all jobs at
    their next checkpoint, a second one at once.

    Args:
        plan: what is wanted; its finished jobs are left alone.
        root: of the reproduction.
        launcher: where jobs run.
        jobs: most jobs at a time.
        cores: of each.
        device: of networks.
        plugins: modules that jobs load first.
        attempts: how often a job is tried; each attempt continues the one before.

    Returns:
        What was not finished: failures first, then what depends on them.

    Raises:
        SubmissionError: a queue refuses the first job.
        KeyboardInterrupt: after Ctrl-C, when all jobs have ended.
        SystemExit: likewise after SIGTERM.
    """
    describe(root, plan)
    usual = Work(str(root.resolve()), "", device, cores, cores, plugins)
    loop = _Loop(plan, usual, launcher, jobs, attempts)
    heeded = 0
    with _signals() as received:
        try:
            while loop.waiting or loop.running:
                if len(received) > heeded:
                    heeded += 1
                    loop.stop()
                loop.look()
                if heeded and not loop.running:
                    raise KeyboardInterrupt if received[0] == signal.SIGINT else SystemExit(128 + received[0])
                if heeded or not loop.start():
                    time.sleep(POLL_S)
        except BaseException:
            loop.stop()
            deadline = time.monotonic() + LAST_WAIT_S
            while loop.running and time.monotonic() < deadline:
                loop.look()
                time.sleep(POLL_S)
            raise
    return loop.failures


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Note signals that ask to stop, instead of being interrupted by them; a third one interrupts."""
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        if len(received) > 1:
            raise KeyboardInterrupt
        if not received:
            logger.warning("Stopping at the next checkpoints; press Ctrl-C again to stop at once.")
        received.append(number)

    is_main = threading.current_thread() is threading.main_thread()
    # What the caller ignores (nohup) stays ignored.
    numbers = [
        n for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is not signal.SIG_IGN
    ]
    before = {number: signal.signal(number, note) for number in numbers if is_main}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class _Loop:
    plan: Plan
    usual: Work
    launcher: Launcher
    jobs: int
    attempts: int

    def __post_init__(self) -> None:
        self.waiting = list(self.plan.missing)
        self.finished = {job.key for job in self.plan.jobs} - {job.key for job in self.waiting}
        self.running: list[tuple[Job, Handle, float]] = []
        self.failures: list[Failure] = []
        self.tried: Counter[str] = Counter()
        self.is_stopping, self.resumes = False, -math.inf

    def start(self) -> bool:
        """Start what can be started, and return whether anything was."""
        if time.monotonic() < self.resumes or any(job.is_exclusive for job, *_ in self.running):
            return False
        ready = [job for job in self.waiting if all(needed.key in self.finished for needed in job.needs)]
        shared = [job for job in ready if not job.is_exclusive]
        chosen = shared[: self.jobs - len(self.running)] or ([] if shared or self.running else ready[:1])
        share = max(1, self.jobs // max(1, len(self.running) + len(chosen)))
        for job in chosen:
            work = replace(self.usual, key=job.key)
            if self.launcher.is_one_machine and job.kind == "dataset":
                work = replace(work, workers=work.workers * share)
            if self.launcher.is_one_machine and job.is_exclusive:
                work = replace(work, threads=work.threads * self.jobs)
            try:
                handle = self.launcher.start(work, is_exclusive=job.is_exclusive)
            except SubmissionError as refusal:
                if not self.tried:
                    raise  # what is wrong with the first is wrong with all
                self.resumes = time.monotonic() + REFUSED_S
                logger.warning("%s: %s It is tried again in %g s.", job.key, refusal, REFUSED_S)
                return False
            logger.info("%s: started", job.key)
            self.waiting.remove(job)
            self.tried[job.key] += 1
            self.running.append((job, handle, time.monotonic()))
        return bool(chosen)

    def look(self) -> None:
        """Take in what has ended; give up or try again what has failed."""
        for entry in list(self.running):
            job, handle, began = entry
            lost = handle.poll()
            if lost is None:
                continue
            self.running.remove(entry)
            took, directory = duration(time.monotonic() - began), directory_of(Path(self.usual.root), job.key)
            log, tried = directory / LOG, self.tried[job.key]
            # The job's own record decides: it may have been lost after its work was done.
            if (directory / DONE).exists():
                self.finished.add(job.key)
                count = f"{len(self.finished)} of {len(self.plan.jobs)}"
                logger.info("%s: finished in %s (%s)", job.key, took, count)
                continue
            if self.is_stopping:
                logger.info("%s: stopped after %s", job.key, took)
                continue
            reason = lost or _last_line(log).removeprefix("error: ") or "it ended unfinished"
            if tried < self.attempts:
                self.waiting.insert(0, job)
                again = f"attempt {tried + 1} of {self.attempts}"
                logger.warning("%s: %s after %s; %s (log: %s)", job.key, reason, took, again, log)
                continue
            logger.error("%s: failed after %s: %s (log: %s)", job.key, took, reason, log)
            self.failures.append(Failure(job.key, reason, log, tried))
            self._skip({job.key})

    def _skip(self, lost: set[str]) -> None:
        """Give up what needs something that failed; the plan's order has needs first."""
        for job in list(self.waiting):
            if failed := [needed.key for needed in job.needs if needed.key in lost]:
                self.waiting.remove(job)
                lost.add(job.key)
                self.failures.append(Failure(job.key, f"needs {failed[0]}"))

    def stop(self) -> None:
        """Ask all jobs to stop."""
        self.is_stopping = True
        for _, handle, _ in self.running:
            handle.stop()


def duration(seconds: float) -> str:
    """Return a duration in a form that one reads.

    Examples:
        >>> duration(42.4), duration(4000), duration(100_000)
        ('42 s', '67 min', '27.8 h')
    """
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7_200 else f"{seconds / 3_600:.1f} h"


# --- what jobs have -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Resources:
    """What jobs have: how many at a time, cores of each, and the GPUs of this machine that they share."""

    jobs: int
    cores: int
    gpus: tuple[str, ...] = ()


def divide(
    launcher: str, *, device: str, jobs: int | None, cores: int | None, jobs_per_gpu: int = 1
) -> Resources:
    """Fill in what the user left open.

    On one machine there is a job per core, or, with ``device="cuda"``, per GPU times ``jobs_per_gpu``. The cores are
    divided among them. On a cluster there are 16 jobs, with a core each, or four beside a GPU.

    Raises:
        CRPTproError: a number below 1, no GPU where one is asked for, or more jobs than this machine's GPUs take.
    """
    for name, value in (("jobs", jobs), ("cores-per-job", cores), ("jobs-per-gpu", jobs_per_gpu)):
        if value is not None and value < 1:
            raise CRPTproError(f"--{name} must be at least 1, got {value}.")
    if launcher != "local":
        return Resources(
            jobs or CLUSTER_JOBS, cores or (CLUSTER_GPU_CORES if device.startswith("cuda") else 1)
        )
    gpus: tuple[str, ...] = ()
    if device == "cuda":
        listed = os.environ.get("CUDA_VISIBLE_DEVICES")
        names = map(str, range(torch.cuda.device_count())) if listed is None else listed.split(",")
        gpus = tuple(filter(None, (name.strip() for name in names)))
        if not gpus or not torch.cuda.device_count():
            raise CRPTproError(
                "--device cuda: this machine has no GPU that torch can use; --device cpu always works."
            )
    room = jobs_per_gpu * (len(gpus) or int(device.startswith("cuda")))
    if room and (jobs or 0) > room:
        raise CRPTproError(
            f"--jobs {jobs} are more than the {room} that the GPUs take with --jobs-per-gpu {jobs_per_gpu}: ask for "
            f"fewer, or let more share a GPU."
        )
    jobs = jobs or room or max(1, cpu_cores() // (cores or 1))
    return Resources(jobs, cores or max(1, cpu_cores() // jobs), gpus)


def slurm_parameters(
    *, partition: str | None, hours: float, memory_gb: float, sbatch: Sequence[str], has_gpu: bool
) -> dict[str, Any]:
    """Return the parameters of submitit's Slurm executor that hold for every job.

    Raises:
        CRPTproError: no time, no memory, or an option that is not ``key=value``.

    Examples:
        >>> slurm_parameters(partition="short", hours=2, memory_gb=8, sbatch=("qos=high",), has_gpu=False)
        {'time': 120, 'mem': '8192M', 'partition': 'short', 'additional_parameters': {'qos': 'high'}}
    """
    if not hours * 60 >= 1:
        raise CRPTproError(f"--hours must be at least a minute (0.017), got {hours:g}.")
    if not memory_gb >= 1:
        raise CRPTproError(f"--memory-gb must be at least 1, got {memory_gb:g}.")
    further = {}
    for option in sbatch:
        key, equals, value = option.partition("=")
        if not key or not equals:
            raise CRPTproError(f"--sbatch {option}: write key=value, e.g. qos=high or account=robots.")
        further[key.lstrip("-")] = value
    found: dict[str, Any] = {"time": round(hours * 60), "mem": f"{round(memory_gb * 1024)}M"}
    found |= {} if partition is None else {"partition": partition}
    found |= {"gpus_per_node": 1} if has_gpu else {}
    return found | ({"additional_parameters": further} if further else {})


def _end_with(parent: int) -> None:
    """Stop at the next checkpoint when the command that started this job is gone: nobody would take in its result."""
    while os.getppid() == parent:
        time.sleep(1)
    print("the command that started this job is gone: leaving at the next checkpoint", flush=True)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    order = json.loads(sys.argv[1])
    threading.Thread(target=_end_with, args=(int(sys.argv[2]),), daemon=True).start()
    raise SystemExit(bool(Work(**{**order, "plugins": tuple(order["plugins"])}).run_alone()))

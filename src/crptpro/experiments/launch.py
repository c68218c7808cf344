"""Run the missing jobs of a plan: in processes of this machine, on a Slurm cluster, or on Ray.

A job always has its own process (:meth:`Work.process`), which ends with the process that started it.
"""

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from crptpro.artifact import read_json, write_json
from crptpro.directory_lock import locked
from crptpro.errors import CRPTproError, RecordError, SubmissionError
from crptpro.experiments.jobs import CLOCK, DESCRIPTION, DONE, LOCK, LOG, OWN, Job, Plan, describe, directory_of
from crptpro.free_memory import JOB_BYTES, JOBS_PER_GPU, free_bytes
from crptpro.plugins import loaded_plugins
from crptpro.provenance import cpu_cores, provenance

logger = logging.getLogger(__name__)

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")  # numpy and torch read them at import
WITH_DEVICE = ("encoder", "explored", "finetuned", "run", "probe", "coverage", "embeddings")
"""Kinds of jobs whose command has a ``--device``."""
MAX_REQUEUES = 1_000  # of a Slurm job at its time limit; it makes progress each time
POLL_S = 0.2
REFUSED_S = 60.0  # pause after a queue refused a job
LAST_WAIT_S = 10.0  # wait for jobs that are stopped at once
SLURM_POLL_S = 10.0  # between polls of jobs that stop; submitit alone polls every ten minutes


# --- one job --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    """A job to run, and its resources: everything that is sent to its machine."""

    root: str
    key: str
    device: str = "cpu"
    threads: int = 1
    workers: int = 1
    plugins: Sequence[str] = ()

    @property
    def directory(self) -> Path:
        return directory_of(Path(self.root), self.key)

    def arguments(self) -> list[str]:
        """Return the whole command line of the job after ``crptpro``."""
        content = read_json(self.directory / DESCRIPTION, error=RecordError)
        words = [word.replace(OWN, str(self.directory)) for word in content["command"]]
        for key in content["needs"]:
            words = [word.replace(f"{{{key}}}", str(directory_of(Path(self.root), key))) for word in words]
        for plugin in self.plugins:
            words += ["--plugin", plugin]
        if content["kind"] == "dataset":
            words += ["--workers", str(self.workers)]
        if content["kind"] in WITH_DEVICE:
            words += ["--device", self.device]
        return words

    def process(self, **environment: str) -> subprocess.Popen:
        """Start a process that runs the job and prints to its log; Ctrl-C does not reach it."""
        variables = os.environ | dict.fromkeys(THREAD_VARIABLES, str(self.threads)) | environment
        command = [sys.executable, "-m", "crptpro.cli.job", json.dumps(dataclasses.asdict(self)), str(os.getpid())]
        with open(self.directory / LOG, "ab") as log:
            return subprocess.Popen(command, env=variables, start_new_session=True, stdout=log, stderr=log)

    def run(self, crptpro: Callable[[], None]) -> str:
        """Run or continue the job in this process; returns why it is not finished, or an empty string.

        ``crptpro`` is the main function of the command line, which reads ``sys.argv``.
        """
        now = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
        where = f"{socket.gethostname()}, process {os.getpid()}, {self.device}, {self.threads} threads"
        print(f"--- {now}: {where}", flush=True)
        # Another command, or a killed job on its way to a checkpoint, may still hold the lock.
        with locked(self.directory / LOCK, poll_interval=1):
            if (self.directory / DONE).exists():
                return ""
            torch.set_num_threads(self.threads)
            clock, reason = _clock(self.directory), ""
            sys.argv = ["crptpro", *self.arguments()]
            try:
                crptpro()
            except SystemExit as end:
                if end.code in (130, 143):  # stopped by a signal
                    raise
                reason = _last_line(self.directory / LOG) if end.code else ""
            except Exception as error:  # a defect: the log needs its traceback
                traceback.print_exc()
                reason = f"{type(error).__name__}: {error}"
            if not reason:
                seconds = clock["seconds"] + time.time() - clock["began"]
                how = {"device": self.device, "threads": self.threads, "attempts": clock["attempts"]}
                write_json(self.directory / DONE, {"seconds": seconds, **how, **provenance()})
                (self.directory / CLOCK).unlink(missing_ok=True)
                shutil.rmtree(self.directory / "checkpoints", ignore_errors=True)
                if self.key.startswith("run-"):  # an explorer's replay is measured later
                    shutil.rmtree(self.directory / "replay", ignore_errors=True)
        print(f"error: {reason}" if reason else "finished", flush=True)
        return reason


def _clock(directory: Path) -> dict[str, float]:
    """Begin an attempt. An earlier one that was killed counts until the last change of one of the job's files."""
    clock = {"seconds": 0.0, "attempts": 0}
    with contextlib.suppress(RecordError):
        clock = read_json(directory / CLOCK, error=RecordError)
        last = max(path.stat().st_mtime for path in directory.iterdir() if path.name not in (LOCK, LOG))
        clock["seconds"] += max(0.0, last - clock["began"])
    clock["attempts"] += 1
    clock["began"] = time.time()
    write_json(directory / CLOCK, clock)
    return clock


def _last_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    return next((line for line in reversed(lines) if line.strip()), "").removeprefix("error: ")


def _run_here(work: Work) -> None:
    """Run a job on a node of a cluster; a cancelled job stops at its next checkpoint."""
    process = work.process()
    try:
        process.wait()
    finally:
        process.terminate()
        process.wait()


# --- launchers ------------------------------------------------------------------------------------------------------
#
# A launcher's `start(work, is_exclusive=)` raises SubmissionError if a queue does not take the job now. It returns a
# handle with `poll()`: None while the job runs or is queued, then why it was lost, or an empty string; and
# `stop(at_once)`: end at the next checkpoint, or at once. `is_one_machine`: all jobs share this machine's cores.


class LocalLauncher:
    """Processes of this machine, which share its memory, and its GPUs (indices or UUIDs), evenly."""

    is_one_machine = True

    def __init__(self, gpus: Sequence[str] = (), *, jobs: int = 1) -> None:
        self.gpus = tuple(gpus)
        per_gpu = math.ceil(jobs / max(1, len(gpus)))
        self._shares = {JOB_BYTES: str(free_bytes(torch.device("cpu")) // jobs), JOBS_PER_GPU: str(per_gpu)}
        self._running: list[_Process] = []

    def start(self, work: Work, *, is_exclusive: bool) -> _Process:
        """Start a job on the GPU that has the fewest jobs."""
        self._running = [each for each in self._running if each.process.poll() is None]
        loads = Counter(each.gpu for each in self._running)
        gpu = min(self.gpus, key=lambda name: loads[name], default="")
        process = work.process(**self._shares, **({"CUDA_VISIBLE_DEVICES": gpu} if gpu else {}))
        self._running.append(_Process(process, gpu))
        return self._running[-1]


@dataclass
class _Process:
    process: subprocess.Popen
    gpu: str

    def poll(self) -> str | None:
        status = self.process.poll()
        if status is None:
            return None
        return f"its process was ended by {signal.Signals(-status).name}" if status < 0 else ""

    def stop(self, at_once: bool) -> None:
        self.process.send_signal(signal.SIGINT if at_once else signal.SIGTERM)


class SlurmLauncher:
    """A Slurm cluster, whose nodes share ROOT and the environment of this process.

    The parameters are those of submitit's executor, empty ones left out; its ``cluster`` is ``"local"`` in tests.
    """

    is_one_machine = False

    def __init__(self, parameters: Mapping[str, Any], cluster: str = "slurm") -> None:
        if find_spec("submitit") is None:
            raise CRPTproError("--launcher slurm needs submitit: pip install 'crptpro[slurm]'.")
        if cluster == "slurm" and (shutil.which("srun") is None or shutil.which("sbatch") is None):
            raise CRPTproError(
                "--launcher slurm needs sbatch and srun, which are not here: call it on a login node of the cluster, "
                "or choose --launcher local."
            )
        self.parameters = dict(parameters)
        self.cluster = cluster

    def start(self, work: Work, *, is_exclusive: bool) -> _SlurmJob:
        """Queue a job; an exclusive job requests a whole node."""
        from submitit import AutoExecutor
        from submitit.core.utils import FailedJobError
        from submitit.helpers import FunctionSequence

        parent = Path(work.root) / "submitted"
        parent.mkdir(exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{work.key}-", dir=parent))
        # Since Slurm 22.05 srun does not inherit the cores of sbatch, and would run the job on one.
        setup = [f"export {name}={work.threads}" for name in (*THREAD_VARIABLES, "SRUN_CPUS_PER_TASK")]
        own = {"job_name": work.key, "cpus_per_task": work.threads, "setup": setup, "exclusive": is_exclusive}
        executor = AutoExecutor(folder, cluster=self.cluster, slurm_max_num_timeout=MAX_REQUEUES)
        executor.update_parameters(**{f"slurm_{k}": v for k, v in {**own, **self.parameters}.items() if v})
        task = FunctionSequence()  # queued again at its time limit; the job continues from its own checkpoint
        task.add(_run_here, work)
        try:
            return _SlurmJob(executor.submit(task), folder, work.directory / LOG)
        except FailedJobError as reason:
            shutil.rmtree(folder, ignore_errors=True)
            why = (str(reason).strip().splitlines() or ["it gave no reason"])[-1]
            raise SubmissionError(f"sbatch refused a job: {why} Change --partition, --hours or --sbatch.") from reason


@dataclass
class _SlurmJob:
    job: Any
    folder: Path
    log: Path
    is_stopping: bool = False
    polled: float = -math.inf

    def poll(self) -> str | None:
        is_due = self.is_stopping and time.monotonic() - self.polled > SLURM_POLL_S
        if is_due:
            self.polled = time.monotonic()
        if not self.job.done(force_check=is_due):
            return None
        reason = ""
        if type(self.job.exception()).__name__ == "UncompletedJobError":
            reason = f"the job was lost ({str(self.job.state).lower()})"
            with open(self.log, "a", encoding="utf-8") as log:  # the job may have died before it opened its log
                log.write((self.job.stderr() or "").strip() + "\n")
        shutil.rmtree(self.folder, ignore_errors=True)
        return reason

    def stop(self, at_once: bool) -> None:
        self.is_stopping = True
        for options in [[]] if at_once else [["--state=PENDING"], ["--signal=TERM"]]:
            with contextlib.suppress(OSError):
                subprocess.call(["scancel", *options, self.job.job_id])


class RayLauncher:
    """A Ray cluster whose nodes share ROOT; each job has a number, or a fraction, of its GPUs.

    Without an address: the cluster of ``RAY_ADDRESS``, one that runs here, or a new one on this machine.
    """

    is_one_machine = False

    def __init__(self, address: str | None = None, *, gpus: float = 0) -> None:
        try:
            import ray
        except ImportError as reason:
            raise CRPTproError(f"--launcher ray needs Ray ({reason}): pip install 'crptpro[ray]'.") from None
        address = address or os.environ.get("RAY_ADDRESS") or None
        try:
            host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
            if colon and port.isdigit():  # Ray itself would retry for minutes
                socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as reason:
            first_line = (str(reason).strip().splitlines() or [type(reason).__name__])[0]
            raise CRPTproError(
                f"The Ray cluster {address or 'of this machine'} cannot be used: {first_line}. Give the address that "
                "`ray start --head` printed, as --ray-address HOST:6379, or ray://HOST:10001."
            ) from reason
        self._ray = ray
        # A worker process ends with its job, so that the next job has a fresh one.
        self._run = ray.remote(max_retries=0, max_calls=1, num_gpus=gpus)(_run_here)

    def start(self, work: Work, *, is_exclusive: bool) -> _RayJob:
        """Queue a job; Ray starts it where cores and GPUs are free."""
        return _RayJob(self._ray, self._run.options(name=work.key, num_cpus=work.threads).remote(work))


@dataclass
class _RayJob:
    ray: Any
    task: Any

    def poll(self) -> str | None:
        if not self.ray.wait([self.task], timeout=0)[0]:
            return None
        try:
            self.ray.get(self.task)
        except self.ray.exceptions.RayError as reason:  # its worker or its node is gone, or it was stopped
            last = (str(reason).strip().splitlines() or [""])[-1]
            return f"the job was lost ({type(reason).__name__}: {last})"
        return ""

    def stop(self, at_once: bool) -> None:
        self.ray.cancel(self.task, force=at_once)


# --- which jobs, when -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure:
    """A job that is not finished; without a ``log`` it was not started, because a job that it needs failed."""

    key: str
    reason: str
    log: Path | None = None
    attempts: int = 0


def run_jobs(
    plan: Plan, root: Path, launcher: Any, *, jobs: int = 1, cores: int = 1, device: str = "cpu", attempts: int = 3
) -> list[Failure]:
    """Run every missing job of a plan as soon as all jobs that it needs are finished; returns what is not finished.

    At most ``jobs`` run at a time, with ``cores`` each; an exclusive job starts when no other can. Each of the
    ``attempts`` at a job resumes the one before. Ctrl-C, SIGTERM and SIGHUP stop all jobs at their next checkpoint, a
    second one at once; KeyboardInterrupt or SystemExit is raised when all jobs have ended. A queue that refuses the
    first job raises a ``SubmissionError``.
    """
    describe(root, plan)
    usual = Work(str(root.resolve()), "", device, threads=cores, workers=cores, plugins=loaded_plugins())
    queue = _Queue(plan, usual, launcher, jobs, attempts)
    with _signals_interrupt():
        try:
            while queue.running or queue.ready():
                queue.poll()
                if not queue.start():
                    time.sleep(POLL_S)
        except BaseException:
            queue.stop()
            raise
    for job in queue.waiting:
        missing = next(needed.key for needed in job.needs if needed.key not in queue.finished)
        queue.failures.append(Failure(job.key, f"needs {missing}"))
    return queue.failures


def leave(number: int, frame: object) -> None:
    """Handle a signal by SystemExit."""
    raise SystemExit(128 + number)


@contextlib.contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP interrupt like Ctrl-C; a signal that the caller ignores (nohup) stays ignored."""
    numbers = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is not signal.SIG_IGN]
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, leave) for number in numbers if is_main}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Queue:
    def __init__(self, plan: Plan, usual: Work, launcher: Any, jobs: int, attempts: int) -> None:
        self.count = len(plan.jobs)
        self.usual, self.launcher, self.jobs, self.attempts = usual, launcher, jobs, attempts
        self.waiting = list(plan.missing)
        self.finished = {job.key for job in plan.jobs} - {job.key for job in plan.missing}
        self.running: dict[Job, tuple[Any, float]] = {}
        self.failures: list[Failure] = []
        self.tried: Counter[str] = Counter()
        self.is_stopping = False
        self.resumes = -math.inf

    def ready(self) -> list[Job]:
        """Return the waiting jobs whose needs are finished."""
        return [job for job in self.waiting if all(needed.key in self.finished for needed in job.needs)]

    def start(self) -> bool:
        """Start the jobs that can start, and return whether there were any."""
        if time.monotonic() < self.resumes or any(job.is_exclusive for job in self.running):
            return False
        ready = self.ready()
        chosen = [job for job in ready if not job.is_exclusive]
        if not chosen and not self.running:
            chosen = ready[:1]
        chosen = chosen[: self.jobs - len(self.running)]
        share = max(1, self.jobs // max(1, len(self.running) + len(chosen)))
        for job in chosen:
            work = replace(self.usual, key=job.key)
            if self.launcher.is_one_machine and job.kind == "dataset":
                work = replace(work, workers=work.workers * share)
            if job.is_exclusive:
                work = replace(work, threads=job.facts["threads"])
            try:
                handle = self.launcher.start(work, is_exclusive=job.is_exclusive)
            except SubmissionError as refusal:
                if not self.tried:
                    raise  # every other job would be refused, too
                self.resumes = time.monotonic() + REFUSED_S
                logger.warning("%s: %s It is tried again in %g s.", job.key, refusal, REFUSED_S)
                return False
            logger.info("%s: started", job.key)
            self.waiting.remove(job)
            self.tried[job.key] += 1
            self.running[job] = handle, time.monotonic()
        return bool(chosen)

    def poll(self) -> None:
        """Collect finished jobs."""
        for job, (handle, began) in list(self.running.items()):
            lost = handle.poll()
            if lost is None:
                continue
            del self.running[job]
            directory = directory_of(Path(self.usual.root), job.key)
            took = duration(time.monotonic() - began)
            log, tried = directory / LOG, self.tried[job.key]
            reason = lost or _last_line(log) or "it ended unfinished"
            # The job's own record decides: the job may have been lost after its work was done.
            if (directory / DONE).exists():
                self.finished.add(job.key)
                logger.info("%s: finished in %s (%d of %d)", job.key, took, len(self.finished), self.count)
            elif self.is_stopping:
                logger.info("%s: stopped after %s", job.key, took)
            elif tried < self.attempts:
                self.waiting.insert(0, job)
                again = f"attempt {tried + 1} of {self.attempts}"
                logger.warning("%s: %s after %s; %s (log: %s)", job.key, reason, took, again, log)
            else:
                logger.error("%s: failed after %s: %s (log: %s)", job.key, took, reason, log)
                self.failures.append(Failure(job.key, reason, log, tried))

    def stop(self) -> None:
        """Stop all jobs at their next checkpoint and wait for them; interrupted once more, stop them at once."""
        self.is_stopping = True
        for seconds in (math.inf, LAST_WAIT_S):
            for handle, _ in self.running.values():
                handle.stop(at_once=seconds < math.inf)
            if self.running and seconds == math.inf:
                with contextlib.suppress(OSError):  # the terminal may be closed
                    logger.warning("Stopping at the next checkpoints; press Ctrl-C again to stop at once.")
            deadline = time.monotonic() + seconds
            with contextlib.suppress(KeyboardInterrupt, SystemExit):
                while self.running and time.monotonic() < deadline:
                    self.poll()
                    time.sleep(POLL_S)


def duration(seconds: float) -> str:
    """Return a readable duration, such as 42 s, 67 min or 27.8 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7_200 else f"{seconds / 3_600:.1f} h"


# --- resources ------------------------------------------------------------------------------------------------------


def divide(
    launcher: str, *, device: str, jobs: int | None, cores: int | None, jobs_per_gpu: int = 1
) -> tuple[int, int, tuple[str, ...]]:
    """Return the number of jobs at a time, the cores of each, and the GPUs of this machine that they share.

    On one machine the default is a job per core, or, with ``device="cuda"``, ``jobs_per_gpu`` jobs per GPU, which is
    also the most. The jobs share the cores. On a cluster the default is 16 jobs, with a core each, or four with a GPU.
    """
    for name, value in (("jobs", jobs), ("cores-per-job", cores), ("jobs-per-gpu", jobs_per_gpu)):
        if value is not None and value < 1:
            raise CRPTproError(f"--{name} must be at least 1, got {value}.")
    if launcher != "local":
        return jobs or 16, cores or (4 if device.startswith("cuda") else 1), ()
    gpus: tuple[str, ...] = ()
    if device == "cuda":
        count = torch.cuda.device_count()
        listed = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(count))))
        gpus = tuple(filter(None, map(str.strip, listed.split(","))))
        if not gpus or not count:
            raise CRPTproError("--device cuda: this machine has no GPU that torch can use; --device cpu always works.")
    if device.startswith("cuda"):
        room = jobs_per_gpu * max(1, len(gpus))
        jobs = min(jobs or room, room)
    jobs = jobs or max(1, cpu_cores() // (cores or 1))
    return jobs, cores or max(1, cpu_cores() // jobs), gpus


def slurm_parameters(
    *, partition: str | None, hours: float, memory_gb: float, sbatch: Sequence[str], has_gpu: bool
) -> dict[str, Any]:
    """Return the parameters of submitit's Slurm executor that all jobs share; the launcher leaves out empty ones."""
    if not (hours * 60 >= 1 and memory_gb >= 1):
        raise CRPTproError(f"--hours {hours:g} --memory-gb {memory_gb:g}: a job needs a minute and 1 GB at least.")
    further = {}
    for option in sbatch:
        key, equals, value = option.partition("=")
        if not key or not equals:
            raise CRPTproError(f"--sbatch {option}: write key=value, e.g. qos=high or account=robots.")
        further[key.lstrip("-")] = value
    limits = {"time": round(hours * 60), "mem": f"{round(memory_gb * 1024)}M", "gpus_per_node": int(has_gpu)}
    return {**limits, "partition": partition, "additional_parameters": further}

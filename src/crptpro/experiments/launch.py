"""Run the missing jobs of a plan: in processes of this machine, on a Slurm cluster, on Ray, or in this process."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import io
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
LEFTOVERS = {
    "run": ("checkpoints", "replay"), "encoder": ("checkpoints",), "explored": ("checkpoints",),
    "finetuned": ("checkpoints",),
}  # fmt: skip
"""Directories that only an unfinished job needs."""
WITH_DEVICE = ("encoder", "explored", "finetuned", "run", "probe", "coverage", "embeddings")
CLUSTER_JOBS, CLUSTER_GPU_CORES = 16, 4
MAX_REQUEUES = 1_000
"""How often a Slurm job is queued again when its time was up. Each time it has got further."""
POLL_S, CLOCK_S, REFUSED_S, LAST_WAIT_S, PREEMPTED_S, SLURM_LOOK_S = 0.2, 20.0, 60.0, 10.0, 600.0, 10.0


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
        words = []
        for word in content["command"]:
            for mark, path in places.items():
                word = word.replace(mark, path)
            words.append(word)
        words += [part for plugin in self.plugins for part in ("--plugin", plugin)]
        if content["kind"] == "dataset":
            words += ["--workers", str(self.workers)]
        elif content["kind"] in WITH_DEVICE:
            words += ["--device", self.device]
        return words

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
            with _Clock(self.directory / CLOCK) as clock:
                reason = _command(self.arguments(), self.directory / LOG)
            if not reason:
                how = {"device": self.device, "threads": self.threads, **clock.spent()}
                write_json(self.directory / DONE, {**how, **provenance()})
                clock.path.unlink(missing_ok=True)
                for name in LEFTOVERS.get(self.key.split("-")[0], ()):
                    shutil.rmtree(self.directory / name, ignore_errors=True)
        print(f"error: {reason}" if reason else "finished", flush=True)
        return reason

    def run_alone(self) -> str:
        """Do the same in a process that has nothing else to do: all that it says goes to the job's log."""
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
        while not lock.is_locked:
            with contextlib.suppress(Timeout):
                lock.acquire(timeout=1)
    try:
        yield
    finally:
        lock.release()


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


class _Clock:
    """Counts wall clock over all attempts at a job, also over those that were killed."""

    def __init__(self, path: Path) -> None:
        self.path, self.began = path, time.monotonic()
        kept: dict[str, Any] = {}
        with contextlib.suppress(RecordError):  # of a job that was not begun
            kept = read_json(path, error=RecordError)
        self.before, self.attempts = float(kept.get("seconds", 0)), int(kept.get("attempts", 0)) + 1
        self._ended = threading.Event()

    def __enter__(self) -> _Clock:
        self._write()
        threading.Thread(target=self._run, daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        self._write()

    def spent(self) -> dict[str, Any]:
        return {"seconds": self.before + time.monotonic() - self.began, "attempts": self.attempts}

    def _run(self) -> None:
        while not self._ended.wait(CLOCK_S):
            self._write()

    def _write(self) -> None:
        # A full disk is for those to report who lose something by it.
        with contextlib.suppress(OSError, CRPTproError):
            write_json(self.path, self.spent())


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
    """A job that was started."""

    def poll(self) -> str | None:
        """``None`` while it runs or waits for its turn; then why it was lost, or nothing if its log tells all."""

    def stop(self) -> None:
        """Ask it to write a checkpoint and end; asked again, to end at once."""


class Launcher(Protocol):
    """A place where jobs run; ``is_one_machine`` says whether all of them share this machine's cores."""

    is_one_machine: bool

    def start(self, work: Work, *, is_exclusive: bool) -> Handle:
        """Start a job, or queue it.

        Raises:
            SubmissionError: a queue does not take it now; nothing was started.
        """

    def close(self) -> None:
        """Free what is held; no job is running."""


class InlineLauncher:
    """Runs a job in this process, to its end, when it is started: for a debugger."""

    is_one_machine = True

    def start(self, work: Work, *, is_exclusive: bool) -> Handle:
        """Run the job; what it says is seen, and goes to its log."""
        with (
            open(work.directory / LOG, "a", encoding="utf-8") as log,
            contextlib.redirect_stdout(_Both(sys.stdout, log)),
            contextlib.redirect_stderr(_Both(sys.stderr, log)),
        ):
            try:
                work.run()
            except SystemExit as end:
                if end.code == 130:
                    raise KeyboardInterrupt from None
                raise
        return _Ended()

    def close(self) -> None:
        """Nothing is held."""


class _Ended:
    def poll(self) -> str:
        return ""

    def stop(self) -> None:
        pass


class _Both(io.TextIOBase):
    """Writes to two streams."""

    def __init__(self, *streams: Any) -> None:
        self.streams = streams

    def write(self, text: str) -> int:
        for stream in self.streams:
            stream.write(text)
            stream.flush()
        return len(text)

    def isatty(self) -> bool:
        return bool(self.streams[0].isatty())


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
        """Start a process that ends with this one, and hears no Ctrl-C of the terminal's."""
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

    def close(self) -> None:
        """Nothing is held."""


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
class SlurmJob:
    """A job of Slurm's, as submitit knows it."""

    job: Any
    folder: Path
    log: Path
    is_asked_to_stop: bool = field(default=False, init=False)
    _preempted_since: float = field(default=math.inf, init=False)
    _looked: float = field(default=-math.inf, init=False)

    def poll(self) -> str | None:
        """As of :class:`Handle`; submitit holds that a preempted job comes back, where the cluster may cancel it."""
        if (
            self.is_asked_to_stop and time.monotonic() - self._looked > SLURM_LOOK_S
        ):  # submitit asks every ten minutes
            self._looked = time.monotonic()
            self.job.watcher.get_state(self.job.job_id, mode="force")
        is_preempted = str(self.job.state).upper().startswith("PREEMPTED")
        self._preempted_since = min(self._preempted_since, time.monotonic()) if is_preempted else math.inf
        is_lost = time.monotonic() - self._preempted_since > PREEMPTED_S
        if not self.job.done() and not is_lost:
            return None
        failure = None if is_lost else self.job.exception()
        reason = ""
        if is_lost or type(failure).__name__ == "UncompletedJobError":
            reason = f"the job was lost ({str(self.job.state).lower()})"
            said = (self.job.stderr() or "").strip()
            if said:  # it did not get as far as its log, or the system said why it ended the job
                with open(self.log, "a", encoding="utf-8") as log:
                    log.write(said + "\n")
        shutil.rmtree(self.folder, ignore_errors=True)
        return reason

    def stop(self) -> None:
        """Have Slurm pass SIGTERM on, or take the job from the queue; asked again, cancel it."""
        options = [[]] if self.is_asked_to_stop else [["--state=PENDING"], ["--signal=TERM"]]
        for each in options:
            with contextlib.suppress(OSError):
                subprocess.call(["scancel", *each, self.job.job_id])
        self.is_asked_to_stop = True


class SlurmLauncher:
    """A Slurm cluster, whose nodes share ROOT and the environment of this process.

    Args:
        parameters: of submitit's executor; lines of ``setup`` follow those that set the numbers of threads.
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
        from submitit import LocalExecutor
        from submitit.slurm.slurm import SlurmExecutor

        parent = Path(work.root) / "submitted"
        parent.mkdir(exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{work.key}-", dir=parent))
        executor: Any = (
            SlurmExecutor(folder, max_num_timeout=MAX_REQUEUES)
            if self.cluster == "slurm"
            else LocalExecutor(folder)
        )
        executor.update_parameters(**self.job_parameters(work, is_exclusive=is_exclusive))
        try:
            submitted = executor.submit(_Submitted(work))
        except Exception as reason:
            if type(reason).__name__ != "FailedJobError":
                raise
            shutil.rmtree(folder, ignore_errors=True)
            said = (str(reason).strip().splitlines() or ["it gave no reason"])[-1]
            raise SubmissionError(
                f"sbatch refused a job: {said} Change --partition, --hours or --sbatch."
            ) from reason
        return SlurmJob(submitted, folder, work.directory / LOG)

    def job_parameters(self, work: Work, *, is_exclusive: bool) -> dict[str, Any]:
        """Return what submitit is told of one job."""
        if self.cluster != "slurm":
            return self.parameters
        threads = work.threads
        # Since Slurm 22.05 srun does not ask for the cores that sbatch was given, and would run the job on one.
        setup = [f"export {name}={threads}" for name in (*THREAD_VARIABLES, "SRUN_CPUS_PER_TASK")]
        found = {"job_name": work.key, "cpus_per_task": threads, **self.parameters}
        found["setup"] = [*setup, *self.parameters.get("setup", ())]
        return found | ({"exclusive": True} if is_exclusive else {})

    def close(self) -> None:
        """Nothing is held."""


@dataclass
class RayJob:
    """A task of Ray's."""

    ray: Any
    task: Any
    is_asked_to_stop: bool = field(default=False, init=False)

    def poll(self) -> str | None:
        """As of :class:`Handle`."""
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
        """Interrupt it as Ctrl-C would; asked again, end its worker."""
        self.ray.cancel(self.task, force=self.is_asked_to_stop)
        self.is_asked_to_stop = True


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
        self._ray, self._gpus = ray, gpus
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
            logger.warning(
                "No node of the Ray cluster has the %d cores and %g GPUs that a job asks for: jobs wait until one is "
                "started. If none can be, change --cores-per-job or --device.", cores, gpus,
            )  # fmt: skip
        # A worker ends with its job, as a process of its own would: nothing of a job is left for the next.
        self._run = ray.remote(max_retries=0, max_calls=1)(_run_alone)

    def start(self, work: Work, *, is_exclusive: bool) -> Handle:
        """Queue a job; Ray starts it where cores and GPUs are free."""
        variables = dict.fromkeys(THREAD_VARIABLES, str(work.threads))
        task = self._run.options(
            name=work.key, num_cpus=work.threads, num_gpus=self._gpus, runtime_env={"env_vars": variables}
        ).remote(work)
        return RayJob(self._ray, task)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def _run_alone(work: Work) -> str:
    return work.run_alone()


# --- which jobs, when -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Failure:
    """A job that is not finished.

    Args:
        key: of the job.
        reason: why, in a line.
        log: what it said; ``None`` if it was not started, since something that it needs failed.
        attempts: how often it was tried.
    """

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
    failures: list[Failure] | None = None,
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
        failures: a list that gets what was not finished, also where an error ends this.

    Returns:
        What was not finished: failures first, then what depends on them.

    Raises:
        SubmissionError: a queue refuses the first job.
        KeyboardInterrupt: after Ctrl-C, when all jobs have ended.
        SystemExit: likewise after SIGTERM.
    """
    describe(root, plan)
    usual = Work(str(root.resolve()), "", device, cores, cores, plugins)
    loop = _Loop(plan, usual, launcher, jobs, attempts, [] if failures is None else failures)
    signals, heeded = list[int](), 0
    with _signals_to(signals):
        try:
            while loop.waiting or loop.running:
                if len(signals) > heeded:
                    heeded += 1
                    loop.stop()
                loop.look()
                if heeded and not loop.running:
                    raise KeyboardInterrupt if signals[0] == signal.SIGINT else SystemExit(128 + signals[0])
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
def _signals_to(received: list[int]) -> Iterator[None]:
    """Note signals that ask to stop, instead of being interrupted by them; a third one interrupts."""

    def note(number: int, frame: object) -> None:
        if len(received) > 1:
            raise KeyboardInterrupt
        if not received:
            logger.warning("Stopping at the next checkpoints; press Ctrl-C again to stop at once.")
        received.append(number)

    is_main = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    # What the caller ignores (nohup) stays ignored.
    numbers = [number for number in numbers if is_main and signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield
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
    failures: list[Failure]

    def __post_init__(self) -> None:
        self.waiting = list(self.plan.missing)
        missing = {job.key for job in self.waiting}
        self.finished = {job.key for job in self.plan.jobs} - missing
        self.running: list[tuple[Job, Handle, float]] = []
        self.tried: Counter[str] = Counter()
        self.is_stopping, self.resumes = False, -math.inf

    def start(self) -> bool:
        """Start what can be started, and say whether anything was."""
        self._skip()
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
            began = time.monotonic()
            logger.info("%s: started", job.key)
            try:
                handle = self.launcher.start(work, is_exclusive=job.is_exclusive)
            except SubmissionError as refusal:
                if not self.tried:
                    raise  # what is wrong with the first is wrong with all
                self.resumes = time.monotonic() + REFUSED_S
                logger.warning("%s: %s It is tried again in %g s.", job.key, refusal, REFUSED_S)
                return False
            self.waiting.remove(job)
            self.tried[job.key] += 1
            self.running.append((job, handle, began))
        return bool(chosen)

    def look(self) -> None:
        """Take in what has ended."""
        for entry in list(self.running):
            job, handle, began = entry
            lost = handle.poll()
            if lost is None:
                continue
            self.running.remove(entry)
            took = duration(time.monotonic() - began)
            directory = directory_of(Path(self.usual.root), job.key)
            # The job's own record decides: it may have been lost after its work was done.
            if (directory / DONE).exists():
                self.finished.add(job.key)
                count = f"{len(self.finished)} of {len(self.plan.jobs)}"
                logger.info("%s: finished in %s (%s)", job.key, took, count)
            elif self.is_stopping:
                logger.info("%s: stopped after %s", job.key, took)
            else:
                reason = lost or _last_line(directory / LOG).removeprefix("error: ")
                self._retry(job, reason or "it ended unfinished", took, directory / LOG)

    def _retry(self, job: Job, reason: str, took: str, log: Path) -> None:
        tried = self.tried[job.key]
        if tried >= self.attempts:
            self.failures.append(Failure(job.key, reason, log, tried))
            logger.error("%s: failed after %s: %s (log: %s)", job.key, took, reason, log)
            return
        self.waiting.insert(0, job)
        logger.warning(
            "%s: %s after %s; attempt %d of %d (log: %s)",
            job.key,
            reason,
            took,
            tried + 1,
            self.attempts,
            log,
        )

    def _skip(self) -> None:
        """Give up what needs something that failed; the plan's order has needs first."""
        lost = {failure.key for failure in self.failures}
        for job in list(self.waiting):
            failed = [needed.key for needed in job.needs if needed.key in lost]
            if failed:
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


def visible_gpus() -> tuple[str, ...]:
    """Return numbers or names as ``CUDA_VISIBLE_DEVICES`` lists them; without that variable, every GPU's number."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    if listed is not None:
        return tuple(part.strip() for part in listed.split(",") if part.strip())
    return tuple(map(str, range(torch.cuda.device_count())))


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
    if launcher in ("slurm", "ray"):
        return Resources(
            jobs or CLUSTER_JOBS, cores or (CLUSTER_GPU_CORES if device.startswith("cuda") else 1)
        )
    gpus = visible_gpus() if device == "cuda" else ()
    if device == "cuda" and not (gpus and torch.cuda.device_count()):
        raise CRPTproError(
            "--device cuda: this machine has no GPU that torch can use; --device cpu always works."
        )
    if launcher == "inline":
        return Resources(1, cores or cpu_cores())
    room = jobs_per_gpu * (len(gpus) or int(device.startswith("cuda")))
    if room and (jobs or 0) > room:
        raise CRPTproError(
            f"--jobs {jobs} are more than the {room} that the GPUs take with --jobs-per-gpu {jobs_per_gpu}: ask for "
            f"fewer, or let more share a GPU."
        )
    jobs = jobs or room or max(1, cpu_cores() // (cores or 1))
    return Resources(jobs, cores or max(1, cpu_cores() // jobs), gpus)


OWN_OPTIONS = {
    "cpus-per-task": "--cores-per-job", "time": "--hours", "mem": "--memory-gb", "partition": "--partition",
}  # fmt: skip
"""Options of sbatch that every job is given by one of ours."""


def slurm_parameters(
    *, partition: str | None, hours: float, memory_gb: float, sbatch: Sequence[str], has_gpu: bool
) -> dict[str, Any]:
    """Return the parameters of submitit's Slurm executor that hold for every job.

    Raises:
        CRPTproError: no time, no memory, an option that is not ``key=value``, or one that has an option of its own.

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
        if instead := OWN_OPTIONS.get(key.lstrip("-").replace("_", "-")):
            raise CRPTproError(f"--sbatch {option} would be overruled: say it by {instead}.")
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

"""A pool of spawned processes that collect episodes and cannot hang unnoticed."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from torchrl.envs import EnvBase

from crptpro.data.collect_worker import EpisodeJob, worker_main
from crptpro.errors import CRPTproError, RenderingError, WorkerLostError, error_named
from crptpro.plugins import loaded_plugins
from crptpro.suspension import SuspensionWatch

logger = logging.getLogger(__name__)


@dataclass
class Worker:
    """One process, the job it runs, and when it was last heard of."""

    index: int
    process: Any
    connection: Connection
    job: EpisodeJob | None = None
    last_domain: str = ""
    heard_s: float = 0.0

    def describe(self) -> str:
        """Name the worker and its job."""
        job = f"episode {self.job.episode} of {self.job.domain}" if self.job else "no episode"
        return f"collecting process {self.index} (pid {self.process.pid}, {job})"


class WorkerPool:
    """Runs :class:`EpisodeJob` in ``workers`` processes.

    The processes are spawned, never forked: a fork would share a GL context. Use as a context manager.

    Args:
        factories: Environment factory of each domain, picklable.
        workers: Number of processes.
        stall_timeout_s: Seconds without any sign of life from a busy process after which it counts as hung.

    Raises:
        CRPTproError: if a factory cannot be pickled.
    """

    def __init__(
        self, factories: dict[str, Callable[[], EnvBase]], workers: int, stall_timeout_s: float = 300.0
    ):
        self._stall_timeout_s = stall_timeout_s
        self._suspension = SuspensionWatch()
        for name, factory in factories.items():
            _require_picklable(name, factory)
        context = multiprocessing.get_context("spawn")
        self.workers: list[Worker] = []
        try:
            for index in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=worker_main,
                    args=(theirs, factories, loaded_plugins()),
                    name=f"collect-{index}",
                    daemon=True,
                )
                with _interrupts_ignored():
                    process.start()
                theirs.close()
                self.workers.append(Worker(index, process, ours))
        except BaseException:
            self.close()
            raise

    def submit(self, worker: Worker, job: EpisodeJob) -> None:
        """Hand a job to an idle worker."""
        worker.job, worker.last_domain, worker.heard_s = job, job.domain, time.monotonic()
        self._send(worker, job)

    def cancel(self, domain: str) -> None:
        """End the running episodes of a domain early; whatever they return is to be ignored."""
        for worker in self.workers:
            if worker.job is not None and worker.job.domain == domain:
                self._send(worker, "cancel")

    def messages(self, timeout_s: float = 1.0) -> Iterator[tuple[str, str, Any]]:
        """Yield what the workers report: ``("environment" | "progress" | "episode", domain, payload)``.

        Raises:
            CRPTproError: if a worker failed; the message says which, where and what to do.
            WorkerLostError: if one died.
            RenderingError: if one hangs.
        """
        # A worker's death shows as the end of its pipe, after everything it had still sent.
        ready = wait([worker.connection for worker in self.workers], timeout_s)
        away = self._suspension.away_s()
        for worker in self.workers:
            worker.heard_s = self._suspension.heard_s(worker.heard_s, away_s=away)
        for worker in self.workers:
            if worker.connection in ready:
                try:
                    kind, domain, payload = worker.connection.recv()
                except (EOFError, OSError):  # also in the middle of a message
                    raise self._death(worker) from None
                worker.heard_s = time.monotonic()
                if kind == "error":
                    raise _failure(worker, *payload)
                if kind == "episode":
                    worker.job = None
                yield kind, domain, payload
        now = time.monotonic()
        for worker in self.workers:
            if worker.job is not None and now - worker.heard_s > self._stall_timeout_s:
                raise RenderingError(
                    f"{worker.describe()} has given no sign of life for {self._stall_timeout_s:.0f} s; a "
                    "render driver that hangs is the usual cause. Every finished episode is kept: run the "
                    "same command again, with fewer workers or another backend (MUJOCO_GL=osmesa, or egl)."
                )

    def close(self) -> None:
        """Stop all processes: idle ones are told to, busy ones are ended."""
        for worker in self.workers:
            if worker.job is None:
                with contextlib.suppress(OSError):
                    worker.connection.send(None)
            else:
                worker.process.terminate()
        deadline = time.monotonic() + 5.0
        for worker in self.workers:
            worker.process.join(max(0.1, deadline - time.monotonic()))
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.connection.close()
        self.workers = []

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self, worker: Worker, message: Any) -> None:
        try:
            worker.connection.send(message)
        except OSError:
            raise self._death(worker) from None

    @staticmethod
    def _death(worker: Worker) -> WorkerLostError:
        worker.process.join(2.0)
        code = worker.process.exitcode
        how = (
            f"was killed by signal {-code}" if code is not None and code < 0 else f"exited with status {code}"
        )
        if code == -9:
            hint = "Out of memory is the usual cause of signal 9."
        else:
            hint = (
                'A script that collects needs `if __name__ == "__main__":` around its main program, because '
                "the processes import it; otherwise look at the messages above."
            )
        return WorkerLostError(
            f"{worker.describe()} {how}. {hint} Every finished episode is kept: run the same command again."
        )


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Let a process that is started inside ignore Ctrl-C from its first moment; the parent decides what it ends."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _require_picklable(name: str, factory: Callable[[], EnvBase]) -> None:
    try:
        pickle.dumps(factory)
    except Exception as reason:
        raise CRPTproError(
            f"Domain {name!r} cannot be sent to worker processes ({reason}); its make must be a module-level "
            "function (or functools.partial of one)."
        ) from None


def _failure(worker: Worker, kind: str, message: str, trace: str) -> CRPTproError:
    known = error_named(kind, message)
    if known is not None:
        return known
    logger.error("%s", trace)
    return CRPTproError(
        f"{worker.describe()} failed: {message.strip() or 'see the traceback above'}. "
        "Every finished episode is kept: run the same command again once the cause is removed."
    )

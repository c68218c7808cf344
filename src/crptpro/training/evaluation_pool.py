"""Evaluation in processes of its own: episodes side by side on a snapshot of the agent, while training goes on."""

from __future__ import annotations

import copy
import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from crptpro.errors import CRPTproError, RenderingError, WorkerLostError, error_named
from crptpro.modules import resolve_precision, set_compute_dtype
from crptpro.modules.placement import device_of
from crptpro.plugins import loaded_plugins
from crptpro.suspension import SuspensionWatch
from crptpro.training.agent import PixelAgent
from crptpro.training.evaluate import Episode, episode_seed
from crptpro.training.evaluation_worker import EvaluationJob, OtherEndGone, receive, send

logger = logging.getLogger(__name__)

Outcome = tuple[list[Episode], list[Tensor]]
WORKER_BYTES = 500_000_000
START = "import sys; sys.path[:] = sys.argv[3:]; from crptpro.training.evaluation_worker import main; main()"
REMEDY = "The run is kept up to its last checkpoint: start it again once the cause is removed"


@dataclass
class _Worker:
    """One process, the episode it runs, and when it was last heard of."""

    process: subprocess.Popen[bytes]
    connection: Connection
    episode: int | None = None
    heard_s: float = 0.0


class EvaluationPool:
    """Runs the episodes of one evaluation in several processes.

    Each episode is what :func:`crptpro.training.evaluate` makes of it, whatever the number of processes. They start
    with the first evaluation and end with this process, however it ends. A thread hands out the episodes, so that the
    caller has nothing to do until it wants the result.

    Args:
        make_env: builds the environment, in the processes; see :func:`can_be_sent`.
        workers: processes, at least 1; each renders and computes on one core and takes :data:`WORKER_BYTES` of memory.
        stall_timeout_s: seconds without a sign of life from a busy process after which it counts as hung.
    """

    def __init__(
        self, make_env: Callable[[], EnvBase], *, workers: int, stall_timeout_s: float = 300.0
    ) -> None:
        self._make_env = make_env
        self._count = workers
        self._stall_timeout_s = stall_timeout_s
        self._suspension = SuspensionWatch()
        self._workers: list[_Worker] = []
        self._driver = ThreadPoolExecutor(1, thread_name_prefix="evaluation")
        self._evaluation: Future[Outcome] | None = None
        self._lock = threading.Lock()  # no process may be started while they are being ended
        self._is_closed = False

    def start(self, agent: PixelAgent, *, episodes: int, seed: int, record_episodes: int = 0) -> None:
        """Begin an evaluation of the agent as it is now; returns at once.

        Args:
            agent: on any device; it is evaluated on the CPU.
            episodes: how many, at least 1.
            seed: seed of this evaluation.
            record_episodes: keep the pictures of the first so many episodes.

        Raises:
            RuntimeError: the evaluation before has not been taken yet.
        """
        if self._evaluation is not None:
            raise RuntimeError("One evaluation at a time: take the result of the last one first.")
        snapshot = _snapshot(agent)
        jobs = [
            EvaluationJob(snapshot, episode, episode_seed(seed, episode), episode < record_episodes)
            for episode in range(episodes)
        ]
        self._evaluation = self._driver.submit(self._run, jobs)

    def result(self) -> Outcome:
        """Wait for the evaluation that was started and return it, once, as :func:`crptpro.training.evaluate` does.

        Raises:
            RuntimeError: none was started.
            CRPTproError: if a process failed; the message says what to do.
            WorkerLostError: if one died.
            RenderingError: if one hung.
        """
        evaluation, self._evaluation = self._evaluation, None
        if evaluation is None:
            raise RuntimeError("No evaluation is under way.")
        return evaluation.result()

    def close(self) -> None:
        """End the processes, busy or not. Harmless when called again."""
        with self._lock:
            self._is_closed = True
            for worker in self._workers:
                if worker.episode is not None:
                    worker.process.terminate()
                else:
                    worker.connection.close()  # it frees its render context and ends
        for worker in self._workers:
            try:
                worker.process.wait(5.0)
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
        self._driver.shutdown()
        for worker in self._workers:
            worker.connection.close()
        self._workers, self._evaluation = [], None

    # --- in the driving thread ----------------------------------------------------------------------------------

    def _run(self, jobs: list[EvaluationJob]) -> Outcome:
        waiting, results = list(jobs), dict[int, tuple[Episode, Tensor | None]]()
        self._workers = [worker for worker in self._workers if worker.process.poll() is None]
        while len(self._workers) < min(self._count, len(jobs)):
            self._start_worker()
        while len(results) < len(jobs):
            for worker in self._workers:
                if worker.episode is None and waiting:
                    job = waiting.pop(0)
                    worker.episode, worker.heard_s = job.episode, time.monotonic()
                    self._send(worker, job)
            results.update(self._receive())
        outcomes = [results[index] for index in range(len(jobs))]
        return [episode for episode, _ in outcomes], [p for _, p in outcomes if p is not None]

    def _start_worker(self) -> None:
        ours, theirs = Pipe()
        descriptor = theirs.fileno()
        path = [os.path.abspath(entry) for entry in sys.path]
        with self._lock:
            if self._is_closed:
                raise CRPTproError("The evaluation was given up.")
            # A session of its own: Ctrl-C is for the parent, which decides what it ends.
            try:
                process = subprocess.Popen(
                    [sys.executable, "-c", START, str(descriptor), str(os.getpid()), *path],
                    pass_fds=[descriptor],
                    start_new_session=True,
                )
            except OSError as reason:
                ours.close()
                raise CRPTproError(
                    f"An evaluating process could not be started: {reason}. {REMEDY}."
                ) from reason
            finally:
                theirs.close()
            worker = _Worker(process, ours)
            self._workers.append(worker)
        self._send(worker, loaded_plugins())
        self._send(worker, self._make_env)

    def _receive(self) -> dict[int, tuple[Episode, Tensor | None]]:
        """Wait up to a second for what the busy processes have to say; returns finished episodes."""
        busy = [worker for worker in self._workers if worker.episode is not None]
        ready = wait([worker.connection for worker in busy], 1.0)
        away = self._suspension.away_s()
        finished: dict[int, tuple[Episode, Tensor | None]] = {}
        for worker in busy:
            worker.heard_s = self._suspension.heard_s(worker.heard_s, away_s=away)
            if worker.connection in ready:
                try:
                    kind, payload = receive(worker.connection)
                except OtherEndGone:
                    raise _death(worker) from None
                worker.heard_s = time.monotonic()
                if kind == "error":
                    raise _failure(*payload)
                if kind == "episode":
                    worker.episode = None
                    finished[payload[0].episode] = payload
            elif time.monotonic() - worker.heard_s > self._stall_timeout_s:
                raise RenderingError(
                    f"{_name(worker)} has given no sign of life for {self._stall_timeout_s:.0f} s; a render driver "
                    f"that hangs is the usual cause. {REMEDY}, with eval_workers=0, or with MUJOCO_GL=osmesa or egl."
                )
        return finished

    @staticmethod
    def _send(worker: _Worker, message: object) -> None:
        try:
            send(worker.connection, message)
        except OtherEndGone:
            # It may have said why before it went.
            with suppress(OtherEndGone):
                while worker.connection.poll():
                    kind, payload = receive(worker.connection)
                    if kind == "error":
                        raise _failure(*payload) from None
            raise _death(worker) from None


def can_be_sent(make_env: Callable[[], EnvBase]) -> bool:
    """Tell whether another process can rebuild a factory: it pickles, and needs nothing of the main program."""
    try:
        return b"__main__" not in pickle.dumps(make_env)
    except Exception:  # objects may refuse in ways of their own
        return False


def _snapshot(agent: PixelAgent) -> bytes:
    """Pickle a copy on the CPU; one from a GPU changes to the precision that this CPU is good at."""
    encoder, actor = copy.deepcopy(agent.encoder), copy.deepcopy(agent.actor)
    if device_of(encoder) != torch.device("cpu") and encoder.compute_dtype == torch.bfloat16:
        for module in (encoder, actor):
            set_compute_dtype(module, resolve_precision("auto", "cpu"))
    return pickle.dumps(PixelAgent(encoder.cpu(), actor.cpu()))


def _name(worker: _Worker) -> str:
    job = "idle" if worker.episode is None else f"episode {worker.episode}"
    return f"An evaluating process (pid {worker.process.pid}, {job})"


def _death(worker: _Worker) -> WorkerLostError:
    try:
        code = worker.process.wait(2.0)
        how = f"was killed by signal {-code}" if code < 0 else f"exited with status {code}"
    except subprocess.TimeoutExpired:
        how = "closed its connection"
    hint = " Out of memory is the usual cause." if how.endswith("signal 9") else ""
    return WorkerLostError(f"{_name(worker)} {how}.{hint} {REMEDY}.")


def _failure(kind: str, message: str, trace: str) -> CRPTproError:
    known = error_named(kind, message)
    if known is not None:
        return known
    logger.error("%s", trace)
    return CRPTproError(
        f"An evaluating process failed: {message.strip() or 'see the traceback above'}. {REMEDY}."
    )

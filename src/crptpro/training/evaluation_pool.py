"""Evaluation in processes of its own: episodes side by side on a snapshot of the agent, while training goes on."""

from __future__ import annotations

import copy
import logging
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from crptpro import errors
from crptpro.errors import CRPTproError, RenderingError
from crptpro.modules import resolve_precision, set_compute_dtype
from crptpro.modules.placement import device_of
from crptpro.training.agent import PixelAgent
from crptpro.training.evaluate import Episode, episode_seed
from crptpro.training.evaluation_worker import EvaluationJob, receive, send

logger = logging.getLogger(__name__)

START = "from crptpro.training.evaluation_worker import main; main()"
REMEDY = "The run is kept up to its last checkpoint: start it again once the cause is removed"


@dataclass
class _Worker:
    """One process, the episode it runs, and when it was last heard of."""

    process: subprocess.Popen[bytes]
    connection: Connection
    episode: int | None = None
    heard_s: float = 0.0


@dataclass
class _Evaluation:
    """What is asked and what has come back."""

    episodes: int
    waiting: list[EvaluationJob]
    results: dict[int, tuple[Episode, Tensor | None]] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        return len(self.results) == self.episodes


class EvaluationPool:
    """Runs the episodes of one evaluation in several processes.

    Each episode is what :func:`crptpro.training.evaluate` makes of it, whatever the number of processes. They start
    with the first evaluation and end with this process, however it ends.

    Args:
        make_env: builds the environment, in the processes; see :func:`can_be_sent`.
        workers: processes, at least 1; each renders and computes on one core and takes about 0.5 GB of memory.
        stall_timeout_s: seconds without a sign of life from a busy process after which it counts as hung.
    """

    def __init__(
        self, make_env: Callable[[], EnvBase], *, workers: int, stall_timeout_s: float = 300.0
    ) -> None:
        self._make_env = make_env
        self._count = workers
        self._stall_timeout_s = stall_timeout_s
        self._workers: list[_Worker] = []
        self._evaluation: _Evaluation | None = None

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
        self._evaluation = _Evaluation(episodes, jobs)
        while len(self._workers) < min(self._count, episodes):
            self._workers.append(self._start_worker())
        self._hand_out(self._evaluation)

    def take(self, *, is_awaited: bool) -> tuple[list[Episode], list[Tensor]] | None:
        """Return the evaluation that was started, once: as :func:`crptpro.training.evaluate` does.

        Args:
            is_awaited: return only when it is complete.

        Returns:
            ``None`` if there is none, or it is not complete and not awaited.

        Raises:
            CRPTproError: if a process failed, died or hangs; the message says what to do.
        """
        evaluation = self._evaluation
        if evaluation is None:
            return None
        self._receive(evaluation, timeout_s=0.0)
        while is_awaited and not evaluation.is_complete:
            self._receive(evaluation, timeout_s=1.0)
        if not evaluation.is_complete:
            return None
        self._evaluation = None
        outcomes = [evaluation.results[index] for index in range(evaluation.episodes)]
        return [episode for episode, _ in outcomes], [p for _, p in outcomes if p is not None]

    def close(self) -> None:
        """End the processes, busy or not."""
        for worker in self._workers:
            worker.connection.close()
            worker.process.terminate()
        for worker in self._workers:
            try:
                worker.process.wait(5.0)
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
        self._workers, self._evaluation = [], None

    def _start_worker(self) -> _Worker:
        ours, theirs = Pipe()
        descriptor = theirs.fileno()
        process = subprocess.Popen(
            [sys.executable, "-c", START, str(descriptor), str(os.getpid())],
            pass_fds=[descriptor],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        theirs.close()
        worker = _Worker(process, ours)
        self._send(worker, self._make_env)
        return worker

    def _hand_out(self, evaluation: _Evaluation) -> None:
        for worker in self._workers:
            if worker.episode is None and evaluation.waiting:
                job = evaluation.waiting.pop(0)
                worker.episode, worker.heard_s = job.episode, time.monotonic()
                self._send(worker, job)

    def _receive(self, evaluation: _Evaluation, *, timeout_s: float) -> None:
        """Take in what has arrived, then give free processes the next episodes."""
        ready = wait([worker.connection for worker in self._workers], timeout_s)
        for worker in self._workers:
            if worker.connection in ready:
                try:
                    kind, payload = receive(worker.connection)
                except (EOFError, ConnectionResetError):
                    raise _death(worker) from None
                worker.heard_s = time.monotonic()
                if kind == "error":
                    raise _failure(*payload)
                if kind == "episode":
                    worker.episode = None
                    evaluation.results[payload[0].episode] = payload
        self._hand_out(evaluation)
        for worker in self._workers:
            if worker.episode is not None and time.monotonic() - worker.heard_s > self._stall_timeout_s:
                raise RenderingError(
                    f"{_name(worker)} has given no sign of life for {self._stall_timeout_s:.0f} s; a render driver "
                    f"that hangs is the usual cause. {REMEDY}, with eval_workers=0, or with MUJOCO_GL=osmesa or egl."
                )

    @staticmethod
    def _send(worker: _Worker, message: object) -> None:
        try:
            send(worker.connection, message)
        except OSError:
            raise _death(worker) from None


def can_be_sent(make_env: Callable[[], EnvBase]) -> bool:
    """Tell whether another process can rebuild a factory: it pickles, and needs nothing of the main program."""
    try:
        return b"__main__" not in pickle.dumps(make_env)
    except (pickle.PicklingError, AttributeError, TypeError):
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


def _death(worker: _Worker) -> CRPTproError:
    try:
        code = worker.process.wait(2.0)
        how = f"was killed by signal {-code}" if code < 0 else f"exited with status {code}"
    except subprocess.TimeoutExpired:
        how = "closed its connection"
    hint = " Out of memory is the usual cause." if how.endswith("signal 9") else ""
    return CRPTproError(f"{_name(worker)} {how}.{hint} {REMEDY}.")


def _failure(kind: str, message: str, trace: str) -> CRPTproError:
    known = getattr(errors, kind, None) if kind else None
    if known is not None:
        return known(message)
    logger.error("%s", trace)
    return CRPTproError(
        f"An evaluating process failed: {message.strip() or 'see the traceback above'}. {REMEDY}."
    )

"""What runs in an evaluating process: episodes of an agent it is sent, one at a time, on one core.

Started by :class:`crptpro.training.evaluation_pool.EvaluationPool` with a file descriptor and its parent's pid,
not spawned by ``multiprocessing``: a spawned process would import the caller's main program again.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from crptpro.errors import error_name
from crptpro.plugins import load_again
from crptpro.training.evaluate import Policy, run_episode

HEARTBEAT_S = 1.0


@dataclass(frozen=True)
class EvaluationJob:
    """One episode to run.

    Args:
        policy: pickled; maps one observation to one action.
        episode: index within the evaluation.
        seed: what the environment is seeded with.
        is_recorded: send the pictures back too.
    """

    policy: bytes
    episode: int
    seed: int
    is_recorded: bool


class OtherEndGone(Exception):
    """Nobody is left to talk to."""


def send(connection: Connection, message: object) -> None:
    """Send an object whole; ``Connection.send`` would share tensors through servers that the other end cannot reach.

    Raises:
        OtherEndGone: if the other process has closed the connection or ended.
    """
    try:
        connection.send_bytes(pickle.dumps(message))
    except OSError as reason:
        raise OtherEndGone from reason


def receive(connection: Connection) -> Any:
    """Receive what :func:`send` sent.

    Raises:
        OtherEndGone: if the other process has closed the connection or ended.
    """
    try:
        content = connection.recv_bytes()
    except (EOFError, OSError) as reason:
        raise OtherEndGone from reason
    return pickle.loads(content)


def serve(connection: Connection) -> None:
    """Receive the parent's plugins, the environment's factory, then jobs until the other end closes.

    Messages back: ``("alive", None)`` about once a second, ``("episode", (Episode, pictures or None))``, and
    ``("error", (name of our error or "", message, traceback))`` as the last one.
    """
    env: EnvBase | None = None
    try:
        load_again(receive(connection))
        make_env: Callable[[], EnvBase] = receive(connection)
        while True:
            job: EvaluationJob = receive(connection)
            env = env or make_env()
            policy = _with_heartbeat(pickle.loads(job.policy), connection)
            outcome = run_episode(
                policy, env, episode=job.episode, seed=job.seed, is_recorded=job.is_recorded
            )
            send(connection, ("episode", outcome))
    except OtherEndGone:
        pass
    except Exception as reason:
        with suppress(OtherEndGone):
            send(connection, ("error", (error_name(reason), str(reason), traceback.format_exc())))
    finally:
        if env is not None:
            env.close()


def _with_heartbeat(policy: Policy, connection: Connection) -> Policy:
    last = time.monotonic()

    def act(pixels: Tensor) -> Tensor:
        nonlocal last
        if time.monotonic() - last >= HEARTBEAT_S:
            send(connection, ("alive", None))
            last = time.monotonic()
        return policy(pixels)

    return act


def _exit_with(parent: int) -> None:
    """End this process when its parent has ended, however it ended."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def main() -> None:
    """Serve on the inherited file descriptor, as long as the parent lives."""
    threading.Thread(target=_exit_with, args=(int(sys.argv[2]),), daemon=True).start()
    # One thread to draw and one to compute: episodes run side by side, and the arithmetic is that of `evaluate`.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    serve(Connection(int(sys.argv[1])))

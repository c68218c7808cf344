"""Worker processes, spawned and ended with their parent, and threads: each with one core for its tensor operations."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import torch

from crptpro.plugins import load_plugin, loaded_plugins

SPAWN = multiprocessing.get_context("spawn")
"""Forked processes would share a GL context."""


def can_be_sent(content: Any) -> bool:
    """Whether another process can import a function, or an object's class; it cannot import those of a notebook."""
    main_file = getattr(sys.modules.get("__main__"), "__file__", None)
    try:
        return b"__main__" not in pickle.dumps(content) or bool(main_file and Path(main_file).exists())
    except Exception:  # objects may raise anything
        return False


class Inline(Executor):
    """An executor that does the work at once, in the thread that submits it."""

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **options))
        except BaseException as reason:
            future.set_exception(reason)
        return future


def single_core_threads(count: int, name: str) -> ThreadPoolExecutor:
    """Return a pool of started threads whose tensor operations run on one core each.

    A second thread with a team of its own makes OpenMP put all threads to sleep between two operations, for there are
    more of them than cores: a downstream update in bfloat16 on two cores then took 119 ms, against 110 ms.
    """
    before = torch.get_num_threads()
    together = threading.Barrier(count)

    def compute_alone(_: int) -> None:
        together.wait(60.0)  # every thread of the pool must get one of these calls
        torch.get_num_threads()  # a thread's first call sets its number to the process's
        torch.set_num_threads(1)

    pool = ThreadPoolExecutor(count, thread_name_prefix=name)
    try:
        list(pool.map(compute_alone, range(count)))
    finally:
        together.abort()  # if a thread could not start, the others stop waiting
        torch.set_num_threads(before)  # the number is per thread, but new threads take the last one set
    return pool


class WorkerPool(ProcessPoolExecutor):
    """An executor whose processes call ``prepare(*arguments)`` first, and ignore Ctrl-C, which their parent handles."""

    def __init__(self, workers: int, prepare: Callable[..., None], *arguments: Any) -> None:
        main = sys.modules["__main__"]
        if not Path(getattr(main, "__file__", None) or ".").exists():  # "<stdin>", which no process can run again
            del main.__file__
        super().__init__(workers, SPAWN, _begin, (loaded_plugins(), prepare, arguments))
        self.processes: dict[int, Any] = {}

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        # A process that is started for the call ignores Ctrl-C from its first moment.
        is_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
        try:
            return super().submit(function, *arguments, **options)
        finally:
            self.processes |= self._processes or {}
            if is_main:
                signal.signal(signal.SIGINT, before)

    def end(self) -> None:
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            process.join(5.0)
            if process.is_alive():
                process.kill()
        self.shutdown(cancel_futures=True)


def _begin(plugins: tuple[str, ...], prepare: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # One software-rendering thread per process is faster than several; it must be set before GL loads.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    # dm_control warns of every pose of an arm that it rejects, in the middle of the progress bar.
    logging.getLogger("absl").setLevel(logging.ERROR)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    for name in plugins:
        load_plugin(name)
    prepare(*arguments)


def _exit_with_parent() -> None:
    parent: Any = multiprocessing.parent_process()
    wait([parent.sentinel])
    os._exit(1)

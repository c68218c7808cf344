"""Threads that compute alone: PyTorch uses one core for what each of them asks for."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import torch

START_TIMEOUT_S = 60.0


def lone_threads(count: int, name: str) -> ThreadPoolExecutor:
    """Start threads whose tensor operations run on one core each; the caller's number of cores stays.

    Args:
        count: threads, all started when this returns.
        name: prefix of their names.

    Raises:
        RuntimeError: if the system does not start them.
    """
    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(count, thread_name_prefix=name)
    together = threading.Barrier(count)

    def compute_alone(_: int) -> None:
        together.wait(START_TIMEOUT_S)  # so that every thread of the pool gets one of these calls
        torch.get_num_threads()  # a thread's first question sets its number to the process's
        torch.set_num_threads(1)

    try:
        list(pool.map(compute_alone, range(count)))
    except BaseException:
        together.abort()  # or those that did start would wait for the others for ever, and the exit for them
        pool.shutdown(wait=False)
        raise
    finally:
        # The number is kept per thread, but some libraries take the last one set for all.
        torch.set_num_threads(before)
    return pool

"""Jobs of this machine that end when the process that started them is gone: nobody would take in what they make."""

from __future__ import annotations

import os
import signal
import threading
import time

import psutil

LOOK_S = 1.0
"""How often a job looks."""


def leave_with(pid: int) -> None:
    """Send SIGTERM to this process, as its scheduler would to stop it, once another process of this machine is gone.

    A scheduler that is killed (out of memory, ``kill -9``) tells nobody. Its jobs would go on for hours on cores that
    the next command believes to be free.

    Args:
        pid: of the other process; nothing happens while it lives.
    """
    try:
        other = psutil.Process(pid)  # by its time of birth, too: numbers of processes come again
    except psutil.NoSuchProcess:
        other = None
    threading.Thread(target=_watch, args=(other,), name="orphan-watch", daemon=True).start()


def _watch(other: psutil.Process | None) -> None:
    while other is not None and _lives(other):
        time.sleep(LOOK_S)
    print("the command that started this job is gone: leaving at the next checkpoint", flush=True)
    os.kill(os.getpid(), signal.SIGTERM)


def _lives(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
    except psutil.Error:  # it is there, and not to be looked at
        return True

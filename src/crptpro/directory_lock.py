"""One writer per directory: a lock that ends with its process, however it ends."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

from crptpro.errors import CRPTproError

logger = logging.getLogger(__name__)

_held: dict[Path, tuple[int, int, int]] = {}
"""Re-entrant locks of this process: handle, holders, and the process that took it (a fork inherits this table)."""


class DirectoryLock:
    """Holds ``directory`` for this process, so that two of them never write one record; freed even by a kill.

    It is taken at construction. Use it as a context manager, or call :meth:`release`.

    Args:
        directory: Made if it is missing; the lock is the file ``.lock`` in it, which stays.
        error: What is raised.
        is_reentrant: Several re-entrant holders in one process share the lock: the record of a run and its training
            loop.
        wait: Called with the seconds since the first try while another process holds the directory, which is then tried
            again; it sleeps, or raises. Without it that is an error.

    Raises:
        CRPTproError: (or ``error``) if another process holds the directory, or it cannot be written.
    """

    def __init__(
        self,
        directory: str | Path,
        *,
        error: type[CRPTproError] = CRPTproError,
        is_reentrant: bool = False,
        wait: Callable[[float], None] | None = None,
    ):
        path = Path(directory)
        self._handle: int | None = None
        self._shared_as: Path | None = None
        try:
            path.mkdir(parents=True, exist_ok=True)
            key = path.resolve()
            if is_reentrant and key in _held and _held[key][2] == os.getpid():
                handle, holders, process = _held[key]
                _held[key] = (handle, holders + 1, process)
                self._shared_as = key
                return
            self._handle = os.open(path / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as reason:
            raise error(f"{path} cannot be written: {reason}.") from reason
        began = time.monotonic()
        while not _take(self._handle):
            try:
                if wait is None:
                    raise error(
                        f"Another process is writing to {path}. Wait for it, end it, or choose another directory."
                    )
                wait(time.monotonic() - began)
            except BaseException:
                self.release()
                raise
        if is_reentrant:
            _held[key] = (self._handle, 1, os.getpid())
            self._handle, self._shared_as = None, key

    def release(self) -> None:
        """Free the directory, once its last holder does; calling it twice is harmless."""
        if self._shared_as is not None:
            handle, holders, process = _held.pop(self._shared_as)
            if holders > 1:
                _held[self._shared_as] = (handle, holders - 1, process)
            else:
                self._handle = handle
            self._shared_as = None
        if self._handle is not None:
            with contextlib.suppress(OSError):
                os.close(self._handle)
            self._handle = None

    def __enter__(self) -> DirectoryLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def _take(handle: int) -> bool:
    """Take the lock unless another process has it."""
    try:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError) as reason:  # not POSIX, or a file system without locks: go on unguarded
        _warn_unguarded(str(reason))
    return True


@functools.cache
def _warn_unguarded(reason: str) -> None:
    """Say once what nobody will prevent."""
    logger.warning(
        "Directories cannot be locked here (%s): see to it that no two processes write to the same one.",
        reason,
    )

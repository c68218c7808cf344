"""Locks that are released when their process ends, however it ends."""

from __future__ import annotations

import contextlib
import errno
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from crptpro.errors import CRPTproError
from crptpro.values import as_path

_LOG = logging.getLogger(__name__)
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)


@contextlib.contextmanager
def locked(path: Path, *, poll_interval: float = 0.05) -> Iterator[None]:
    """Hold a lock file in the block, after waiting for it; a file system without locks only causes a warning."""
    lock = FileLock(path, fallback_to_soft=False)  # a soft lock would outlive a kill
    try:
        lock.acquire(timeout=1e9, poll_interval=poll_interval)
    except OSError as reason:
        _announce(path, reason)
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def refusal_leaves_nothing(directory: Path) -> Iterator[None]:
    """Remove a directory that was created in the block, if an error leaves nothing but a lock in it."""
    is_new = not directory.exists()
    try:
        yield
    except Exception:
        if is_new and directory.exists() and {path.name for path in directory.iterdir()} <= {".lock"}:
            shutil.rmtree(directory)
        raise


class DirectoryLock:
    """Locks ``directory`` for this process, so that no two processes write one record; a kill frees it too.

    It is taken at construction, which raises ``error`` if the directory is locked already, or cannot be written.
    Re-entrant holders in one process, a run's record and its training loop, share the lock.
    """

    def __init__(self, directory: str | Path, *, error: type[CRPTproError] = CRPTproError, is_reentrant: bool = False):
        path = as_path(directory)
        self._lock: FileLock | None = None
        try:
            path.mkdir(parents=True, exist_ok=True)
            lock = FileLock(path.resolve() / ".lock", is_singleton=True, thread_local=False, fallback_to_soft=False)
            if lock.is_locked and not is_reentrant:
                raise error(f"This process is already writing to {path}: close it first, e.g. dataset.writer.close().")
            lock.acquire(blocking=False)
            self._lock = lock
        except Timeout:
            raise error(
                f"Another process is writing to {path}. Wait for it, end it, or choose another directory."
            ) from None
        except OSError as reason:
            if reason.errno not in _NO_LOCKS:
                raise error(f"{path} cannot be written: {reason}.") from reason
            _announce(path, reason)

    def release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> DirectoryLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def _announce(path: Path, reason: OSError) -> None:
    if reason.errno not in _NO_LOCKS:
        raise reason
    _LOG.warning("%s cannot be locked (%s): make sure that no two processes write to it.", path, reason)

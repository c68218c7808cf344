"""One writer per directory: a lock that ends with its process, however it ends."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from crptpro.errors import CRPTproError


class DirectoryLock:
    """Holds ``directory`` for this process, so that two of them never write one record; freed even by a kill.

    It is taken at construction. Use it as a context manager, or call :meth:`release`.

    Args:
        directory: Made if it is missing; the lock is the file ``.lock`` in it, which stays.
        error: What is raised.

    Raises:
        CRPTproError: (or ``error``) if another process holds the directory, or it cannot be written.
    """

    def __init__(self, directory: str | Path, *, error: type[CRPTproError] = CRPTproError):
        path = Path(directory)
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._handle: int | None = os.open(path / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as reason:
            raise error(f"{path} cannot be written: {reason}.") from reason
        try:
            import fcntl

            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise error(
                f"Another process is writing to {path}. Wait for it, end it, or choose another directory."
            ) from None
        except (ImportError, OSError):  # not POSIX, or a file system without locks: go on unguarded
            pass

    def release(self) -> None:
        """Free the directory; calling it twice is harmless."""
        if self._handle is not None:
            with contextlib.suppress(OSError):
                os.close(self._handle)
            self._handle = None

    def __enter__(self) -> DirectoryLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

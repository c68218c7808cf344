"""One run per directory: a lock that ends with its process, however it ends."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from crptpro.errors import CheckpointError


@contextlib.contextmanager
def exclusive(directory: str | Path) -> Iterator[None]:
    """Hold ``directory`` for this process, so that two runs never write one record; freed even by a kill.

    Raises:
        CheckpointError: if another process holds it.
    """
    path = Path(directory)
    path.mkdir(parents=True, exist_ok=True)
    with open(path / ".lock", "a+") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CheckpointError(
                f"Another process is running in {path}. Wait for it, end it, or choose another directory."
            ) from None
        except (ImportError, OSError):  # not POSIX, or a file system without locks: run unguarded
            pass
        yield

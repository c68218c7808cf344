"""What a job does, wherever it runs: make one piece, with everything it says in the piece's log."""

from __future__ import annotations

import contextlib
import datetime
import logging
import os
import socket
import sys
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from crptpro.console import configure_logging, is_expected
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CRPTproError, RecordError, RenderingError, WorkerLostError
from crptpro.experiments.building import JobSettings, build
from crptpro.experiments.store import LOG, PIECES, Store
from crptpro.plugins import load_again
from crptpro.training.stop_request import StopRequest

logger = logging.getLogger(__name__)

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""What numpy and torch read when they are loaded; a launcher sets them before its job starts."""

RETRY_S = 0.5
"""How often a job that waits for another process to let go of its piece looks again."""


@dataclass(frozen=True)
class Work:
    """One piece to make; all that travels to a job.

    Args:
        root: of the reproduction, absolute.
        key: of the piece, which is described there.
        settings: where and how.
        gpus: value of ``CUDA_VISIBLE_DEVICES`` in the job; ``None`` leaves it as it is.
    """

    root: str
    key: str
    settings: JobSettings
    gpus: str | None = None

    @property
    def log(self) -> Path:
        """File that the job's output is appended to."""
        return Path(self.root) / PIECES / self.key / LOG

    def run(self) -> str:
        """Make the piece in this process, or continue it.

        Returns:
            Nothing if it is finished, else the message of one of this library's errors: trying again would not help.

        Raises:
            Exception: what may go better another time.
        """
        if self.gpus is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = self.gpus
        try:
            load_again(self.settings.plugins)
            store = Store(Path(self.root))
            piece = store.described(self.key)
            with _lock(store.path(piece)):
                build(piece, store, self.settings)
        except Exception as error:
            if not _is_final(error):
                raise
            return str(error) or type(error).__name__
        return ""

    def run_logged(self) -> str:
        """Do the same in a process that has nothing else to do: everything written goes to the piece's log."""
        with _output_to(self.log):
            configure_logging()
            print(self.heading(), flush=True)
            try:
                refusal = self.run()
            except (KeyboardInterrupt, SystemExit):
                print("stopped", flush=True)
                raise
            except BaseException:
                traceback.print_exc()
                raise
            print(f"error: {refusal}" if refusal else "finished", flush=True)
            return refusal

    def heading(self) -> str:
        """First line of an attempt in the log."""
        now = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
        where = f"{socket.gethostname()}, process {os.getpid()}, {self.settings.device}"
        return f"--- {now}: {where}, {self.settings.threads} threads"


def _is_final(error: Exception) -> bool:
    """Whether the same would happen again.

    A picture that came too late may come in time, and a process that the system killed may find memory another time.
    """
    if isinstance(error, CRPTproError):
        return not isinstance(error, (RenderingError, WorkerLostError))
    return isinstance(error, ValueError) and is_expected(error)


def _lock(directory: Path) -> DirectoryLock:
    """Take a piece, once nobody else makes it.

    Another command may want it too, and the job of one that was killed goes on to the end of its episode; neither is a
    reason to give the piece up. What the other finishes is then found finished.
    """
    with StopRequest() as stop:

        def wait(waited_s: float) -> None:
            if waited_s < RETRY_S:
                logger.warning("Another process is making %s; waiting until it ends.", directory.name)
            time.sleep(RETRY_S)
            if stop.signal is not None:
                stop.leave()

        return DirectoryLock(directory, error=RecordError, is_reentrant=True, wait=wait)


@contextlib.contextmanager
def _output_to(path: Path) -> Iterator[None]:
    """Append standard output and error to a file, those of child processes too."""
    path.parent.mkdir(parents=True, exist_ok=True)
    streams = (sys.stdout, sys.stderr)
    kept = [os.dup(number) for number in (1, 2)]
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    before = (sys.stdout, sys.stderr)
    try:
        for stream in streams:
            stream.flush()
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        # What stands in for them may write elsewhere: Ray's copies go to its own files.
        sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1, closefd=False) for number in (1, 2))
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        sys.stdout, sys.stderr = before
        for number, copy in zip((1, 2), kept):
            os.dup2(copy, number)
            os.close(copy)
        os.close(handle)

"""Ctrl-C and SIGTERM as a request to a loop, instead of an exception in the middle of an update."""

from __future__ import annotations

import logging
import signal
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crptpro.training.checkpoint import CheckpointDir

logger = logging.getLogger(__name__)


class StopRequest:
    """While active, Ctrl-C and SIGTERM ask the loop to stop between two updates instead of tearing one.

    A second Ctrl-C stops at once. Outside the main thread, where Python delivers no signals, it does nothing.

    Args:
        announcement: logged when the request arrives, for loops that take a while to heed it.

    Attributes:
        signal: the signal received, or ``None``.
    """

    def __init__(self, announcement: str = "") -> None:
        self.signal: int | None = None
        self._announcement = announcement
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def leave(self) -> None:
        """End the program the way the signal would have: KeyboardInterrupt, or exit status 143."""
        if self.signal == signal.SIGTERM:
            raise SystemExit(128 + signal.SIGTERM)
        raise KeyboardInterrupt

    def _receive(self, number: int, frame: object) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        if self._announcement:
            logger.warning(self._announcement)


def what_is_kept(checkpoints: CheckpointDir | None) -> str:
    """Return what a run that is stopped leaves behind, for its message."""
    return "nothing is kept without run_dir" if checkpoints is None else "a checkpoint was written"

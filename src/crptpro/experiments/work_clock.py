"""How long a piece has been worked on, over all attempts, the killed ones too."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from pathlib import Path
from types import TracebackType

from crptpro.cards import read_json, write_json
from crptpro.errors import DiskSpaceError, RecordError

logger = logging.getLogger(__name__)

INTERVAL_S = 20.0
"""How often the time is written down: what a kill takes from the count."""


class WorkClock:
    """Counts wall clock while it is entered, and goes on from what earlier attempts counted.

    The time in which the process was suspended does not count.

    Args:
        path: file that keeps the count between attempts.
        interval_s: how often it is written.
    """

    def __init__(self, path: Path, interval_s: float = INTERVAL_S) -> None:
        self.path, self.interval_s = path, interval_s
        self.seconds, self.attempts = 0.0, 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="work clock", daemon=True)

    def __enter__(self) -> WorkClock:
        """Read what earlier attempts left and start to count."""
        if self.path.exists():
            try:
                kept = read_json(self.path, error=RecordError)
                self.seconds, self.attempts = float(kept["seconds"]), int(kept["attempts"])
            except (RecordError, KeyError, TypeError, ValueError) as reason:
                logger.warning("The time spent on earlier attempts is lost: %s", reason)
        self.attempts += 1
        self._counted_to = time.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Count up to now; the file stays for the next attempt."""
        self._ended.set()
        self._thread.join()
        self._count()

    def _run(self) -> None:
        while not self._ended.wait(self.interval_s):
            self._count()

    def _count(self) -> None:
        now = time.monotonic()
        # A wait that took twice as long as it was to take was that of a suspended process.
        passed = now - self._counted_to
        self.seconds += passed if passed < 2 * self.interval_s else self.interval_s
        self._counted_to = now
        # A full disk is for those to report who lose something by it.
        with contextlib.suppress(OSError, DiskSpaceError):
            write_json(self.path, {"seconds": self.seconds, "attempts": self.attempts})

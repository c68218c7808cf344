"""How far a pre-training is: a bar on a terminal, a line per twentieth in a log file."""

from __future__ import annotations

import logging
import time

from tqdm.auto import tqdm

logger = logging.getLogger(__name__)

LINES = 20


class PretrainProgress:
    """Shows updates, loss, updates/s and the time left. Usable as a context manager.

    Args:
        updates: wanted in total.
        done: updates done by an earlier call.
        is_shown: False for silence.
    """

    def __init__(self, updates: int, done: int, *, is_shown: bool = True) -> None:
        self.updates, self.begun_at, self.is_shown = updates, done, is_shown
        self.started_s = time.monotonic()
        self.lines = LINES * done // updates
        self.bar = tqdm(
            total=updates,
            initial=done,
            desc="pretrain",
            unit="update",
            disable=None if is_shown else True,
            leave=False,
        )

    def __enter__(self) -> PretrainProgress:
        return self

    def __exit__(self, *exception: object) -> None:
        self.bar.close()

    def update(self) -> None:
        """One more update is done."""
        self.bar.update()

    def row(self, done: int, loss: float) -> None:
        """A row of the record was written: show its loss."""
        if not self.bar.disable:
            self.bar.set_postfix(loss=f"{loss:.4f}", refresh=False)
            return
        lines = LINES * done // self.updates
        if not self.is_shown or lines == self.lines:
            return
        self.lines = lines
        rate = (done - self.begun_at) / max(time.monotonic() - self.started_s, 1e-9)
        logger.info(
            "pretrain: %s of %s updates (%d %%), loss %.4f, %.2f updates/s, %.0f s left",
            f"{done:,}", f"{self.updates:,}", 100 * done // self.updates, loss, rate, (self.updates - done) / rate,
        )  # fmt: skip

"""How far a pre-training is: a bar on a terminal, a line per twentieth in a log file."""

from __future__ import annotations

import logging
import time

from tqdm.auto import tqdm

logger = logging.getLogger(__name__)

LINES = 20


class PretrainProgress:
    """Shows what is done, the loss, the rate and the time left. Usable as a context manager.

    Args:
        total: wanted.
        done: by an earlier call.
        unit: of both.
        is_shown: False for silence.
    """

    def __init__(self, total: int, done: int, *, unit: str = "update", is_shown: bool = True) -> None:
        self.total, self.begun_at, self.unit, self.is_shown = total, done, unit, is_shown
        self.started_s = time.monotonic()
        self.lines = LINES * done // total
        self.bar = tqdm(
            total=total,
            initial=done,
            desc="pretrain",
            unit=unit,
            disable=None if is_shown else True,
            leave=False,
        )

    def __enter__(self) -> PretrainProgress:
        return self

    def __exit__(self, *exception: object) -> None:
        self.bar.close()

    def update(self, count: int = 1) -> None:
        """So much more is done."""
        self.bar.update(count)

    def row(self, done: int, loss: float) -> None:
        """A row of the record was written: show its loss."""
        if not self.bar.disable:
            self.bar.set_postfix(loss=f"{loss:.4f}", refresh=False)
            return
        lines = LINES * done // self.total
        if not self.is_shown or lines == self.lines:
            return
        self.lines = lines
        rate = (done - self.begun_at) / max(time.monotonic() - self.started_s, 1e-9)
        logger.info(
            "pretrain: %s of %s %ss (%d %%), loss %.4f, %.2f %ss/s, %.0f s left",
            f"{done:,}", f"{self.total:,}", self.unit, 100 * done // self.total, loss, rate, self.unit,
            (self.total - done) / rate,
        )  # fmt: skip

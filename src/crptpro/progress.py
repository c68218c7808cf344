"""Progress of long work: a bar on a terminal, occasional lines in a log file."""

from __future__ import annotations

import logging
import time

from tqdm.auto import tqdm

logger = logging.getLogger(__name__)


class Progress:
    """Shows progress from ``done`` to ``total`` units; a log file gets ``lines`` lines in total."""

    def __init__(
        self, total: int, done: int, unit: str, *, label: str = "", is_shown: bool = True, lines: int = 20
    ) -> None:
        self.total, self.done, self.unit, self.label = total, done, unit, label
        self._lines, self._is_shown = lines, is_shown
        self._first, self._began, self._last_line = done, time.monotonic(), lines * done // max(total, 1)
        self._bar = tqdm(
            total=total, initial=done, unit=f" {unit}", desc=label or None, leave=False, dynamic_ncols=True,
            disable=None if is_shown else True,
        )  # fmt: skip

    def reach(self, done: int) -> None:
        self._bar.update(done - self.done)
        self.done = done

    def show(self, **values: float) -> None:
        """Show values beside the bar, or log a line if one is due."""
        texts = [f"{name} {value:.4g}" for name, value in values.items()]
        if not self._bar.disable:
            self._bar.set_postfix_str(", ".join(texts), refresh=False)
            return
        line = self._lines * self.done // max(self.total, 1)
        if not self._is_shown or line <= self._last_line:
            return
        self._last_line = line
        rate = (self.done - self._first) / max(time.monotonic() - self._began, 1e-9)
        left = tqdm.format_interval((self.total - self.done) / max(rate, 1e-9))
        texts += [f"{rate:{',.0f' if rate >= 100 else '.3g'}} {self.unit}/s", f"{left} left"]
        logger.info(
            "%s%s of %s %s (%d %%), %s",
            f"{self.label}: " if self.label else "", f"{self.done:,}", f"{self.total:,}", self.unit,
            100 * self.done // max(self.total, 1), ", ".join(texts),
        )  # fmt: skip

    def close(self) -> None:
        self._bar.close()

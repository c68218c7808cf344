"""One progress line per domain on a terminal, one log line per tenth in a log file."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from tqdm import tqdm

logger = logging.getLogger(__name__)


class CollectProgress:
    """Shows transitions, transitions/s and the time left of each domain.

    Args:
        totals: transitions wanted, by domain.
        initial: transitions already there.
        is_shown: False for silence; bars also vanish where the output is no terminal.
    """

    def __init__(self, totals: Mapping[str, int], initial: Mapping[str, int], is_shown: bool = True):
        self._totals, self._is_shown = dict(totals), is_shown
        self._begun: dict[str, tuple[float, int]] = {}
        self._tenths = {name: 10 * initial[name] // total for name, total in totals.items()}
        width = max(map(len, totals), default=0)
        self._bars = {
            name: tqdm(
                total=total,
                initial=initial[name],
                desc=name.ljust(width),
                unit=" transitions",
                position=position,
                disable=None if is_shown else True,
                dynamic_ncols=True,
                smoothing=0.05,
            )
            for position, (name, total) in enumerate(totals.items())
        }

    def update(self, name: str, transitions: int) -> None:
        """Show that ``transitions`` of a domain exist."""
        bar = self._bars[name]
        if not bar.disable:
            bar.update(transitions - bar.n)
            return
        # Domains take turns when there are fewer workers: each has its own clock, from its first report on.
        begun_s, before = self._begun.setdefault(name, (time.monotonic(), transitions))
        tenth = 10 * transitions // self._totals[name]
        if self._is_shown and tenth > self._tenths[name]:
            self._tenths[name] = tenth
            elapsed_s = time.monotonic() - begun_s
            speed = ""
            if transitions > before and elapsed_s > 0:
                rate = (transitions - before) / elapsed_s
                left_s = (self._totals[name] - transitions) / rate
                speed = f", {rate:.1f} transitions/s, {left_s:.0f} s left"
            logger.info(
                "%s: %s of %s transitions (%d %%)%s",
                name, f"{transitions:,}", f"{self._totals[name]:,}", 10 * tenth, speed,
            )  # fmt: skip

    def close(self) -> None:
        """Leave the bars as they are."""
        for bar in self._bars.values():
            bar.close()

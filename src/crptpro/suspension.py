"""Telling the silence of other processes from a time in which this one was suspended and heard nobody."""

from __future__ import annotations

import time

LONG_S = 10.0
"""Between two looks; what is longer was no wait for messages."""


class SuspensionWatch:
    """Says when others were last heard, as far as this process could hear them.

    It cannot while it is stopped by a signal, or asleep with the whole machine.

    Examples:
        >>> watch = SuspensionWatch()
        >>> watch.heard_s(17.0, away_s=watch.away_s())
        17.0
    """

    def __init__(self) -> None:
        self._looked_s = time.monotonic()

    def away_s(self) -> float:
        """Return the seconds since the last call if they are too many for a wait, 0 otherwise."""
        now = time.monotonic()
        passed, self._looked_s = now - self._looked_s, now
        return passed if passed > LONG_S else 0.0

    def heard_s(self, before_s: float, *, away_s: float) -> float:
        """Return the time of ``time.monotonic`` from which silence counts.

        Args:
            before_s: when the other process was heard last.
            away_s: what :meth:`away_s` just said.
        """
        return min(self._looked_s, before_s + away_s) if away_s else before_s

"""``crptpro report``: one page with everything that a reproduction, or a directory of runs, gave."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Report:
    """Write tables beside the paper's, figures and cards as one HTML page, and as Markdown."""

    directory: Positional[Path]
    """directory of `crptpro reproduce`, or any with downstream runs in or below it"""
    out: Path | None = None
    """directory of the report (default: DIRECTORY/report)"""
    bootstrap_seed: int = 0
    """of the intervals: the same seed gives the same intervals"""
    replicates: int = 2_000
    """resamples per interval"""

    def run(self) -> None:
        """Write the page and say where it is."""
        from crptpro.experiments.intervals import Bootstrap
        from crptpro.experiments.report import build_report

        bootstrap = Bootstrap(replicates=self.replicates, seed=self.bootstrap_seed)
        page = build_report(self.directory, out=self.out, bootstrap=bootstrap)
        print(page)

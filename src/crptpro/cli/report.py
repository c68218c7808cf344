"""``crptpro report``: one page with everything that a reproduction, or a directory of runs, gave."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Report:
    """Write tables beside the paper's, figures and jobs as an HTML page, and as Markdown."""

    directory: Positional[Path]
    """directory of `crptpro reproduce`, or any with downstream runs in or below it"""
    out: Path | None = None
    """directory of the report (default: DIRECTORY/report)"""

    def run(self) -> None:
        """Write the page, then say where it is."""
        from crptpro.experiments.report import build_report

        page = str(build_report(self.directory, out=self.out))
        encoding = sys.stdout.encoding or "utf-8"
        print(page.encode(encoding, "backslashreplace").decode(encoding))  # whatever the terminal can show

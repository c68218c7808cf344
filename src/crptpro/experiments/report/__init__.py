"""One page that says what an experiment gave, beside what the paper printed."""

from crptpro.experiments.report.page import build_report

__all__ = ["build_report"]

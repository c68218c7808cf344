"""The progress of a collection in a log file."""

from __future__ import annotations

import logging

import pytest

from crptpro.data import collect_progress
from crptpro.data.collect_progress import CollectProgress


def test_a_domain_that_starts_late_is_timed_from_its_own_start(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    reports = [(10, "early", 100), (20, "early", 200), (500, "late", 50), (510, "late", 250)]
    lines = CollectProgress({"early": 1_000, "late": 1_000}, {"early": 0, "late": 0})
    with caplog.at_level(logging.INFO, logger="crptpro"):
        for time_s, name, transitions in reports:
            monkeypatch.setattr(collect_progress.time, "monotonic", lambda time_s=time_s: time_s)
            lines.update(name, transitions)
    lines.close()
    assert [record.message for record in caplog.records] == [
        "early: 100 of 1,000 transitions (10 %)",
        "early: 200 of 1,000 transitions (20 %), 10.0 transitions/s, 80 s left",
        "late: 250 of 1,000 transitions (20 %), 20.0 transitions/s, 38 s left",
    ]

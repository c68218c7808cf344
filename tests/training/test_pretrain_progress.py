"""The progress of a pre-training in a log file."""

from __future__ import annotations

import logging

import pytest
from pretrain_world import SETTINGS, make_datasets, make_loss

from crptpro.training import pretrain
from crptpro.training.pretrain import progress


def test_a_log_file_gets_a_line_per_twentieth_with_speed_and_time_left(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(progress.time, "monotonic", lambda: 100.0)
    shown = progress.PretrainProgress(1_000, 200)
    monkeypatch.setattr(progress.time, "monotonic", lambda: 120.0)
    with caplog.at_level(logging.INFO, logger="crptpro"), shown:
        shown.row(210, 6.5)
        shown.row(260, 6.25)
        shown.row(280, 6.0)
    assert [record.message for record in caplog.records] == [
        "pretrain: 260 of 1,000 updates (26 %), loss 6.2500, 3.00 updates/s, 247 s left"
    ]


def test_a_run_says_what_it_will_do_and_how_far_it_is(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="crptpro"):
        pretrain(make_loss(), make_datasets(), updates=4, **{**SETTINGS, "log_interval": 2, "progress": True})
    lines = [record.message for record in caplog.records if record.message.startswith("pretrain:")]
    assert (
        lines[0] == "pretrain: 4 updates of batch 8, one domain after the other (dark, bright); fp32 on cpu"
    )
    assert [line.split(",")[0] for line in lines[1:]] == [
        "pretrain: 2 of 4 updates (50 %)",
        "pretrain: 4 of 4 updates (100 %)",
    ]

from __future__ import annotations

import logging
import time
from pathlib import Path

import pytest

from crptpro.cards import read_json, write_json
from crptpro.errors import DiskSpaceError
from crptpro.experiments.work_clock import WorkClock


class Time:
    """A clock that the test moves."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("crptpro.experiments.work_clock.time.monotonic", lambda: self.now)


def test_attempts_add_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time_, path = Time(monkeypatch), tmp_path / "clock.json"
    with WorkClock(path):
        time_.now += 7.5
    time_.now += 1_000  # nobody works
    with WorkClock(path) as clock:
        time_.now += 2
    assert (clock.seconds, clock.attempts) == (9.5, 2)
    assert read_json(path) == {"seconds": 9.5, "attempts": 2}


def test_an_attempt_that_fails_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time_, path = Time(monkeypatch), tmp_path / "clock.json"

    def work() -> None:
        with WorkClock(path):
            time_.now += 3
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert read_json(path)["seconds"] == 3


def test_a_suspended_process_does_not_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time_ = Time(monkeypatch)
    with WorkClock(tmp_path / "clock.json", interval_s=20) as clock:
        time_.now += 3_600
    assert clock.seconds == 20


def test_the_count_is_on_disk_while_work_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "clock.json"
    with WorkClock(path, interval_s=0.05):
        deadline = time.monotonic() + 20
        while not path.exists() or read_json(path)["seconds"] < 0.1:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_a_damaged_count_starts_anew_with_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    time_, path = Time(monkeypatch), tmp_path / "clock.json"
    write_json(path, {"seconds": None})
    with caplog.at_level(logging.WARNING), WorkClock(path) as clock:
        time_.now += 1
    assert (clock.seconds, clock.attempts) == (1, 1)
    assert "earlier attempts is lost" in caplog.text


@pytest.mark.parametrize("error", [DiskSpaceError("The disk is full."), OSError(5, "Input/output error")])
def test_a_full_or_broken_disk_is_left_to_others_to_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def refuse(*_: object) -> None:
        raise error

    time_ = Time(monkeypatch)
    monkeypatch.setattr("crptpro.experiments.work_clock.write_json", refuse)
    with WorkClock(tmp_path / "clock.json") as clock:
        time_.now += 1
    assert clock.seconds == 1

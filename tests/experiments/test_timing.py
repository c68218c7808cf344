"""The clock and the sums; real trainings are timed in test_measuring.py."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from torch import nn

from crptpro.errors import RecordError
from crptpro.experiments import timing
from crptpro.experiments.building import JobSettings
from crptpro.experiments.measurements import TimingPiece
from crptpro.experiments.pieces import PretrainedPiece, UntrainedPiece
from crptpro.experiments.row_files import write_rows
from crptpro.experiments.store import Store
from crptpro.experiments.timing import WINDOWS, UpdateClock, time_training, timing_row


class Steps(nn.Module):
    """Stands for a loss: being called is an update."""

    def forward(self) -> None: ...


def tick(monkeypatch: pytest.MonkeyPatch, times: list[float]) -> None:
    following: Iterator[float] = iter(times)
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(following))


@pytest.mark.parametrize(("period", "updates"), [(1, 1), (3, 2), (3, 100), (9, 25), (2, 20)])
def test_all_domains_have_equal_parts_in_the_warm_up_and_in_every_window(period: int, updates: int) -> None:
    clock = UpdateClock(Steps(), period, updates, "cpu")  # type: ignore[arg-type]
    assert clock.warm_up % period == clock.window % period == 0
    assert clock.warm_up >= updates
    assert updates <= WINDOWS * clock.window < updates + WINDOWS * period
    assert clock.updates == clock.warm_up + WINDOWS * clock.window + 1


def test_an_update_takes_what_it_takes_in_the_median_window(monkeypatch: pytest.MonkeyPatch) -> None:
    loss = Steps()
    clock = UpdateClock(loss, 2, 10, "cpu")  # type: ignore[arg-type]
    assert (clock.warm_up, clock.window, clock.updates) == (10, 2, 21)
    tick(monkeypatch, [100.0, 101.0, 102.0, 112.0, 113.5, 115.0])  # one window was disturbed
    for _ in range(clock.updates):
        loss()
    timed = clock.read(decisions_per_update=6)
    assert timed == (10, 60, 15.0, 1.5 / 2)
    loss()  # not timed any more


def test_what_has_no_training_of_its_own_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="no training of its own"):
        time_training(UntrainedPiece("random-encoder", 0), Store(tmp_path), JobSettings(), updates=1)


def test_encoders_of_single_domains_cost_the_sum_of_theirs(tmp_path: Path) -> None:
    store = Store(tmp_path)
    encoders = tuple(PretrainedPiece("apt-s", seed, (), updates=10) for seed in (0, 1))
    piece = TimingPiece(encoders, encoders, updates=5)
    row: dict[str, Any] = {
        "method": "apt-s", "domains": 1, "encoder_updates": 5, "decisions": 10, "seconds": 20.0,
        "seconds_per_update": 4.0, "seconds_per_decision": 2.0, "budget_updates": 900, "budget_decisions": 1800,
        "projected_hours": 1.0, "paper_updates": 100, "paper_decisions": 400, "paper_seconds_per_update": 18.0,
        "paper_projected_hours": 0.5,
        "collection_seconds": "", "threads": 1, "device": "cpu",
    }  # fmt: skip
    other = {**row, "seconds": 30.0, "seconds_per_update": 8.0, "projected_hours": 2.0}
    for part, one in zip(piece.parts, (row, other)):
        write_rows(store.path(part) / "timing.csv", timing.COLUMNS, [one])
    found = timing_row(piece, store, JobSettings())
    assert {name: str(value) for name, value in found.items()} == {
        "method": "apt-s", "domains": "2", "encoder_updates": "10", "decisions": "20", "seconds": "50.0",
        "seconds_per_update": "6.0", "seconds_per_decision": "3.0", "budget_updates": "1800",
        "budget_decisions": "3600", "projected_hours": "3.0", "paper_updates": "200", "paper_decisions": "800",
        "paper_seconds_per_update": "18.0", "paper_projected_hours": "1.0", "collection_seconds": "",
        "threads": "1", "device": "cpu",
    }  # fmt: skip
    assert set(found) == set(timing.COLUMNS)
    write_rows(
        store.path(piece.parts[1]) / "timing.csv", timing.COLUMNS, [{**other, "paper_projected_hours": ""}]
    )
    assert timing_row(piece, store, JobSettings())["paper_projected_hours"] == ""

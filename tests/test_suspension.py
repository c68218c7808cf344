"""A process that was stopped does not blame others for the silence."""

from __future__ import annotations

import time
from multiprocessing import Pipe
from types import SimpleNamespace
from typing import Any

import pytest

from crptpro.data.collect_pool import WorkerPool
from crptpro.errors import RenderingError
from crptpro.suspension import LONG_S, SuspensionWatch
from crptpro.training.evaluation_pool import EvaluationPool


def silent_worker(heard_s: float) -> Any:
    ours, theirs = Pipe()
    return SimpleNamespace(
        connection=ours, theirs=theirs, heard_s=heard_s, job=object(), episode=0, index=0,
        describe=lambda: "collecting process 0", process=SimpleNamespace(pid=1),
    )  # fmt: skip


def test_waits_are_no_absence_and_what_is_longer_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("crptpro.suspension.time.monotonic", lambda: now)
    watch = SuspensionWatch()
    now += LONG_S
    assert watch.away_s() == 0
    now += 400
    assert watch.away_s() == 400
    assert watch.heard_s(now - 700, away_s=400) == now - 300
    assert watch.heard_s(now - 300, away_s=400) == now  # and no later
    assert watch.away_s() == 0


@pytest.mark.parametrize("kind", ["collecting", "evaluating"])
def test_silence_counts_from_the_end_of_a_suspension(kind: str) -> None:
    worker = silent_worker(time.monotonic() - 400)
    pool: Any
    if kind == "collecting":
        pool = WorkerPool({}, workers=0)
        pool.workers = [worker]

        def listen() -> object:
            return list(pool.messages(timeout_s=0.01))

    else:
        pool = EvaluationPool(lambda seed: None, workers=1)  # type: ignore[arg-type, return-value]
        pool._workers, listen = [worker], pool._receive
    pool._suspension._looked_s -= 400  # nobody listened since the worker was heard
    listen()
    worker.heard_s -= 400  # this time somebody did
    with pytest.raises(RenderingError, match="no sign of life for 300 s"):
        listen()
    pool.workers = pool._workers = []

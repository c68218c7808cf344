"""A plateau is announced and passes; a dead run is called so."""

from __future__ import annotations

import logging
import math
from typing import Any

import pytest

from crptpro.training import CollapseMonitor

UNIFORM = math.log(512)


@pytest.mark.parametrize(
    ("comps", "states", "announced", "plateaus"),
    [
        ([6.6, 6.5, 6.4], ["learning"] * 3, [], []),
        (
            [6.6, UNIFORM, UNIFORM, UNIFORM, 6.0, 5.8],
            ["learning", *["plateau"] * 4, "learning"],
            [("INFO", "Update 200: plateau"), ("INFO", "Update 500: left the plateau after 300 updates.")],
            [{"entered": 200, "left": 500}],
        ),
        (  # one observation outside does not end it
            [UNIFORM, 6.1, UNIFORM, 6.1, 6.0],
            [*["plateau"] * 4, "learning"],
            [("INFO", "Update 100: plateau"), ("INFO", "after 300 updates.")],
            [{"entered": 100, "left": 400}],
        ),
        (
            [6.6, UNIFORM],
            ["learning", "plateau"],
            [("INFO", "Update 200: plateau"), ("WARNING", "has not begun to learn")],
            [{"entered": 200, "left": None}],
        ),
        (
            [UNIFORM] * 5,
            [*["plateau"] * 4, "dead"],
            [("INFO", "plateau"), ("ERROR", "DEAD RUN"), ("ERROR", "DEAD RUN: do not use this encoder")],
            [{"entered": 100, "left": None}],
        ),
        (
            [*[UNIFORM] * 5, 5.0, 5.0],
            [*["plateau"] * 4, "dead", "dead", "learning"],
            [("INFO", "plateau"), ("ERROR", "DEAD RUN"), ("WARNING", "after it was declared dead")],
            [{"entered": 100, "left": 600}],
        ),
    ],
)
def test_a_plateau_is_announced_and_passes_or_is_called_dead_when_it_outlasts_patience(
    caplog: pytest.LogCaptureFixture, comps: list[float], states: list[str], announced: list[Any], plateaus: list[Any]
) -> None:
    monitor = CollapseMonitor(512, patience_updates=300)
    with caplog.at_level(logging.INFO):
        found = [monitor.observe(100 * index, comp=comp, cosines={"a": 0.9}) for index, comp in enumerate(comps, 1)]
        verdict = monitor.finish()
    assert [record.levelname for record in caplog.records] == [level for level, _ in announced]
    assert all(words in record.message for record, (_, words) in zip(caplog.records, announced))
    assert found == states
    assert (verdict["verdict"], verdict["plateaus"]) == (states[-1], plateaus)


def test_cosines_are_watched_without_prototypes_and_one_collapsed_domain_is_named(
    caplog: pytest.LogCaptureFixture,
) -> None:
    monitor = CollapseMonitor(None)
    assert monitor.observe(100, comp=UNIFORM, cosines={"walker": 0.5}) == "learning"
    assert monitor.observe(200, comp=None, cosines={"walker": 0.4, "pendulum": 0.9999}) == "learning"
    assert monitor.finish()["collapsed_domains"] == ["pendulum"]
    assert "pendulum" in caplog.text
    assert monitor.observe(300, comp=None, cosines={"walker": 0.999, "pendulum": 0.995}) == "plateau"


def test_a_restored_monitor_judges_as_the_original() -> None:
    original, restored = (CollapseMonitor(512, patience_updates=300) for _ in range(2))
    original.observe(100, comp=UNIFORM, cosines={"a": 0.9})
    original.observe(200, comp=6.0, cosines={"a": 0.9})
    restored.load_state_dict(original.state_dict())
    for updates, comp in ((300, 6.0), (400, UNIFORM), (800, UNIFORM)):
        assert original.observe(updates, comp=comp, cosines={}) == restored.observe(updates, comp=comp, cosines={})
    assert original.finish() == restored.finish()

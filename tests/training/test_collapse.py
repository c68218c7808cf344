"""A plateau is announced and passes; a dead run is called so."""

from __future__ import annotations

import logging
import math

import pytest

from crptpro.training import CollapseMonitor

UNIFORM = math.log(512)


def test_a_run_that_never_stands_still_is_learning(caplog: pytest.LogCaptureFixture) -> None:
    monitor = CollapseMonitor(512)
    with caplog.at_level(logging.INFO):
        states = [monitor.observe(u, comp=6.63 - u / 1000, cosine=0.5) for u in (10, 90, 150)]
    assert set(states) == {"learning"}
    assert monitor.finish(150)["verdict"] == "learning"
    assert not caplog.records


def test_a_plateau_is_announced_once_and_its_end_with_its_length(caplog: pytest.LogCaptureFixture) -> None:
    monitor = CollapseMonitor(512)
    with caplog.at_level(logging.INFO):
        monitor.observe(100, comp=6.6, cosine=0.9)
        for updates in range(200, 1_400, 100):
            assert monitor.observe(updates, comp=UNIFORM, cosine=0.9999) == "plateau"
        monitor.observe(1_400, comp=6.0, cosine=0.7)
        assert monitor.observe(1_500, comp=5.8, cosine=0.6) == "learning"
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO"]
    assert "Update 200: plateau" in caplog.text
    assert "after 1200 updates" in caplog.text
    verdict = monitor.finish(1_500)
    assert verdict["plateaus"] == [{"entered": 200, "left": 1_400}]
    assert (verdict["plateau_updates"], verdict["verdict"]) == (1_200, "learning")


def test_one_observation_outside_does_not_end_a_plateau() -> None:
    monitor = CollapseMonitor(512)
    for updates, comp in ((100, UNIFORM), (200, 6.1), (300, UNIFORM), (400, 6.1)):
        assert monitor.observe(updates, comp=comp, cosine=0.5) == "plateau"
    assert monitor.observe(500, comp=6.0, cosine=0.5) == "learning"
    assert monitor.verdict(500)["plateaus"] == [{"entered": 100, "left": 400}]


def test_a_plateau_beyond_patience_is_dead_and_can_still_recover(caplog: pytest.LogCaptureFixture) -> None:
    monitor = CollapseMonitor(512, patience_updates=300)
    states = [monitor.observe(u, comp=UNIFORM) for u in (100, 200, 300, 400, 500)]
    assert states == ["plateau"] * 4 + ["dead"]
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert monitor.finish(500)["verdict"] == "dead"
    assert "DEAD RUN: do not use this encoder" in caplog.text
    monitor.observe(600, comp=5.0)
    assert monitor.observe(700, comp=5.0) == "learning"
    assert "after it was called dead" in caplog.text


def test_training_that_ends_on_a_short_plateau_is_announced_but_not_called_dead(
    caplog: pytest.LogCaptureFixture,
) -> None:
    monitor = CollapseMonitor(512)
    monitor.observe(100, comp=UNIFORM, cosine=0.5)
    verdict = monitor.finish(150)
    assert (verdict["verdict"], verdict["plateau_updates"]) == ("plateau", 50)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "has not begun to learn" in caplog.text


def test_cosines_are_watched_without_prototypes_and_one_collapsed_domain_is_named(
    caplog: pytest.LogCaptureFixture,
) -> None:
    monitor = CollapseMonitor(None)
    assert monitor.observe(100, comp=UNIFORM, cosine=0.5) == "learning"
    assert monitor.observe(200, cosine={"walker": 0.4, "pendulum": 0.9999}) == "learning"
    assert monitor.finish(200)["collapsed_domains"] == ["pendulum"]
    assert "pendulum" in caplog.text
    assert monitor.observe(300, cosine={"walker": 0.999, "pendulum": 0.995}) == "plateau"


def test_a_restored_monitor_judges_as_the_original() -> None:
    original, restored = (CollapseMonitor(512, patience_updates=300) for _ in range(2))
    original.observe(100, comp=UNIFORM, cosine={"a": 0.9})
    original.observe(200, comp=6.0, cosine={"a": 0.9})
    restored.load_state_dict(original.state_dict())
    for updates, comp in ((300, 6.0), (400, UNIFORM), (800, UNIFORM)):
        assert original.observe(updates, comp=comp) == restored.observe(updates, comp=comp)
    assert original.finish(800) == restored.finish(800)

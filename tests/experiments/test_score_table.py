from __future__ import annotations

import logging
from copy import copy
from pathlib import Path

import numpy as np
import pytest

from crptpro.experiments.estimates import estimate
from crptpro.experiments.records import Episode, Run
from crptpro.experiments.score_table import score_tables


def run(
    method: str, task: str, score: float, *, encoder: str | None = "e0", trains_encoder: bool = False
) -> Run:
    episode = Episode(1000, 500, 400, 0, score, 500, 0, 0.0)
    early = Episode(0, 0, 0, 0, 0.0, 500, 0, 0.0)
    directory = Path(f"{method}_{task}_{score}")
    return Run(directory, method, task, 0, encoder, trains_encoder, 1000, (early, episode), {})


def test_runs_are_sorted_into_a_table_per_method_with_their_encoders() -> None:
    tables = score_tables(
        [
            run("crptpro", "walker_run", 1.0),
            run("atc", "walker_run", 5.0, encoder="x"),
            run("crptpro", "walker_run", 2.0, encoder="e1"),
            run("crptpro", "hopper_hop", 3.0),
        ]
    )
    assert list(tables) == ["atc", "crptpro"]
    table = tables["crptpro"]
    assert {task: s.tolist() for task, s in table.scores.items()} == {
        "walker_run": [1.0, 2.0],
        "hopper_hop": [3.0],
    }
    assert table.encoders == {"walker_run": ("e0", "e1"), "hopper_hop": ("e0",)}
    assert table.only(["hopper_hop"]).encoders == {"hopper_hop": ("e0",)}


def test_score_and_key_are_the_callers() -> None:
    (table,) = score_tables(
        [run("crptpro", "walker_run", 4.0)], score=lambda r: r.last_score(2), key=lambda r: ("A", r.task)
    ).values()
    assert {key: s.tolist() for key, s in table.scores.items()} == {("A", "walker_run"): [2.0]}


def test_a_run_that_trains_its_encoder_counts_as_an_encoder() -> None:
    runs = [run("drq", "walker_run", s, encoder=None, trains_encoder=True) for s in (1.0, 2.0, 3.0)]
    table = score_tables(runs)["drq"]
    assert len(set(table.encoders["walker_run"])) == 3
    assert estimate(table.scores, encoders=table.encoders).interval is not None


def test_an_encoder_that_is_not_recorded_leaves_intervals_over_runs_only(
    caplog: pytest.LogCaptureFixture,
) -> None:
    runs = [run("crptpro", "walker_run", 1.0), run("crptpro", "walker_run", 2.0, encoder=None)]
    with caplog.at_level(logging.WARNING):
        table = score_tables(runs)["crptpro"]
    assert table.encoders is None
    assert table.only(["walker_run"]).encoders is None
    assert "crptpro_walker_run_2.0" in caplog.text
    np.testing.assert_array_equal(table.scores["walker_run"], [1.0, 2.0])


def test_a_run_that_stands_in_two_rows_is_one_run_with_one_encoder() -> None:
    runs = [run("drq", "walker_run", s, encoder=None, trains_encoder=True) for s in (1.0, 2.0, 3.0)]
    twice = [*runs, *map(copy, runs)]
    groups = {id(r): group for r, group in zip(twice, "AAADDD")}
    table = score_tables(twice, key=lambda r: groups[id(r)])["drq"]
    assert table.count == 3
    assert not table.shares_encoders


@pytest.mark.parametrize(
    ("encoders", "shares"),
    [("aabb", True), ("abcd", False), ("aaaa", False), ("abbb", True)],
)
def test_encoders_are_shared_where_there_are_fewer_of_them_than_runs_and_more_than_one(
    encoders: str, shares: bool
) -> None:
    runs = [run("atc", "walker_run", float(i), encoder=name) for i, name in enumerate(encoders)]
    assert score_tables(runs)["atc"].shares_encoders is shares

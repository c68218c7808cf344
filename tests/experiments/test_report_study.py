"""Probes along a training, as the report of a study draws them."""

from __future__ import annotations

from pathlib import Path

import pytest
from report_reading import cell, table_in

from crptpro.experiments.report.blocks import ABSENT, Figure
from crptpro.experiments.report.diagnostics import diagnostics, left_plateau
from crptpro.experiments.report.measurements import Row
from crptpro.experiments.report.reading import Made, Wanted
from crptpro.experiments.report.study import _along


def row(updates: int, r2: str) -> Row:
    place = {"factor": "batch_size", "value": "128", "updates": updates, "encoder_seed": 0}
    goal = Wanted("crptpro", place, Made("probe-x", Path("probe-x"), {"kind": "probe"}, {}))
    read = {"domain": "walker", "colors": "normal", "embedding": "features", "measure": "r2_velocity"}
    return Row(goal, {**read, "value": r2})


def test_an_r2_of_zero_is_a_point_and_a_missing_one_a_gap() -> None:
    (figure,) = _along([row(1, "0.0"), row(2, ""), row(3, "0.5")], "figure", "")
    assert isinstance(figure, Figure)
    drawn = figure.drawing.axes[0].lines[0].get_ydata()
    assert drawn[0] == 0.0
    assert drawn[1] != drawn[1]  # not a number
    assert drawn[2] == 0.5


def record(*losses: float, uniform: str = "4.0") -> list[dict[str, str]]:
    """A row per hundred updates, with losses as shares of ln M."""
    return [
        {"updates": str(100 * (n + 1)), "comp": str(4.0 * share), "ln_num_prototypes": uniform}
        for n, share in enumerate(losses)
    ]


@pytest.mark.parametrize(
    ("losses", "left"),
    [
        ((1.02, 1.0, 0.985, 0.9), 300),
        ((0.9, 1.0, 0.995, 0.98), 400),  # what it was before the plateau does not count
        ((1.0, 0.98, 0.995), None),  # back on it
        ((1.0, 1.0), None),
        ((0.8, 0.7), 100),
    ],
)
def test_a_plateau_is_left_where_the_loss_stays_below_it(losses: tuple[float, ...], left: int | None) -> None:
    assert left_plateau(record(*losses)) == left


def test_the_table_of_diagnostics_says_when_the_plateau_was_left_and_by_how_many_encoders() -> None:
    made = Made("encoder-x", Path("encoder-x"), {}, {})
    records = {
        "all": [record(1.0, 0.9), record(1.0, 1.0, 0.9)],
        "one": [record(1.0, 0.9), record(1.0, 1.0)],
        "none": [record(1.0, 1.0)],
        "no prototypes": [record(1.0, uniform="")],
    }
    rows = [(Wanted(name, {}, made), each) for name, several in records.items() for each in several]
    table = table_in(tuple(diagnostics(rows, lambda goal: goal.label, "value", "figure", "")), "at the end")
    found = {name: cell(table, "left the plateau at", name) for name in records}
    assert (found["all"].text, found["all"].beside) == ("250", "200 to 300")
    assert (found["one"].text, found["one"].beside) == ("200", "1 of 2 encoders")
    assert found["none"].text == "not left"
    assert found["no prototypes"].text == ABSENT

"""Probes along a training, as the report of a study draws them."""

from __future__ import annotations

from pathlib import Path

from crptpro.experiments.report.blocks import Figure
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

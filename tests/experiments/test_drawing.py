"""Figures of a report, read back from matplotlib."""

from __future__ import annotations

import itertools

import pytest

from crptpro.experiments.report import drawing
from crptpro.experiments.report.palette import styles


def test_bars_write_thousands_alike_on_the_axis_and_beside_themselves() -> None:
    figure = drawing.bars(["crptpro", "apt-s"], {"3 domains": [50_000, 373_500]}, "encoder updates")
    axis = figure.axes[0]
    figure.canvas.draw()
    assert "50,000" in {text.get_text() for text in axis.texts}
    assert "100,000" in {label.get_text() for label in axis.get_xticklabels()}


@pytest.mark.parametrize(("low", "high"), [(-0.27, 0.9), (-0.0088, 0.0088), (-0.00093, 0.0031)])
def test_the_numbers_below_panels_of_dots_are_three_at_least_and_do_not_touch(
    low: float, high: float
) -> None:
    style = styles(["crptpro"])["crptpro"]
    panels = [(f"quantity {n}", [drawing.Dots("crptpro", style, [low, high])]) for n in range(2)]
    figure = drawing.dots(["first", "second"], panels, mark=0.0)
    figure.canvas.draw()
    for axis in figure.axes:
        start, end = axis.get_xlim()
        labels = [
            label.get_window_extent()
            for place, label in zip(axis.get_xticks(), axis.get_xticklabels())
            if start <= place <= end
        ]
        assert len(labels) >= 3
        assert all(left.x1 + 3 < right.x0 for left, right in itertools.pairwise(labels))

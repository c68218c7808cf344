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


def _heights(*furthest: float) -> drawing.Panel:
    style = styles(["crptpro"])["crptpro"]
    curves = [drawing.Line(f"curve {end}", style, [0, 1], [0.0, end]) for end in furthest]
    return drawing.Panel("", "encoder updates", "L_intr", curves, compresses=True)


def test_one_curve_far_from_the_others_does_not_press_them_flat() -> None:
    figure = drawing.lines([_heights(0.0003, 0.0004, 0.0005, -0.01)])
    axis = figure.axes[0]
    figure.canvas.draw()
    low, high = axis.get_window_extent().y0, axis.get_window_extent().y1
    places = [axis.transData.transform((0, height))[1] for height in (0.0003, 0.0005)]
    assert (places[1] - places[0]) / (high - low) > 0.05
    labels = [label.get_text() for label in axis.get_yticklabels()]
    assert [label.replace("\N{MINUS SIGN}", "-") for label in labels] == ["-0.01", "-0.001", "0"]
    boxes = [label.get_window_extent() for label in axis.get_yticklabels()]
    assert all(lower.y1 < upper.y0 for lower, upper in itertools.pairwise(boxes))


def test_curves_of_one_size_are_drawn_to_scale() -> None:
    assert drawing.linear_width([[0, 0.3], [0.4], [-2.9]]) is None
    assert drawing.linear_width([]) is None
    assert drawing.linear_width([[0.0], [0.0]]) is None
    assert drawing.lines([_heights(0.3, 0.4, -2.9)]).axes[0].get_yscale() == "linear"

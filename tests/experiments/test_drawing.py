"""Figures of a report, read back from matplotlib."""

from __future__ import annotations

from crptpro.experiments.report import drawing


def test_bars_write_thousands_alike_on_the_axis_and_beside_themselves() -> None:
    figure = drawing.bars(["crptpro", "apt-s"], {"3 domains": [50_000, 373_500]}, "encoder updates")
    axis = figure.axes[0]
    figure.canvas.draw()
    assert "50,000" in {text.get_text() for text in axis.texts}
    assert "100,000" in {label.get_text() for label in axis.get_xticklabels()}

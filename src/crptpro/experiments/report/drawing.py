"""Lines, bars, points and pictures, in colours that a page can turn to light or dark."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crptpro.experiments.plots import make_figure
from crptpro.experiments.report.canvas import INK, grid, legend, theme
from crptpro.experiments.report.palette import Style


@dataclass(frozen=True)
class Line:
    """A curve, with its interval if there is one.

    Args:
        label: in the legend.
        style: of its system.
        x: ``[K]``.
        y: ``[K]``.
        low: lower ends ``[K]``, or ``None``.
        high: upper ends ``[K]``, or ``None``.
    """

    label: str
    style: Style
    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Args:
        title: what distinguishes it from its neighbours.
        x: name and unit of the horizontal axis.
        y: of the vertical one.
        lines: curves.
        marks: heights of dashed lines, with what they say.
        ticks: names of the places 0, 1, ... of the horizontal axis, instead of numbers.
        compresses: whether heights far from 0 are drawn closer together where a few of them would press all others
            flat, see :func:`linear_width`.
    """

    title: str
    x: str
    y: str
    lines: Sequence[Line]
    marks: Mapping[str, float] = field(default_factory=dict)
    ticks: Sequence[str] = ()
    compresses: bool = False


@dataclass(frozen=True)
class Dots:
    """One system's mark in every row of a dot plot.

    Args:
        label: in the legend.
        style: of the system.
        values: one per row; ``None`` leaves a gap.
    """

    label: str
    style: Style
    values: Sequence[float | None]


def lines(panels: Sequence[Panel], *, columns: int = 3) -> Any:
    """Draw curves with one legend below.

    Args:
        panels: at least one.
        columns: panels side by side, at most.

    Returns:
        Matplotlib's figure.
    """
    with theme():
        figure, axes = grid(len(panels), columns)
        named: dict[str, Any] = {}
        for axis, panel in zip(axes, panels):
            for line in panel.lines:
                drawn = _draw(axis, line)
                named.setdefault(line.label, drawn)
            for name, height in panel.marks.items():
                mark = axis.axhline(height, color=INK, linestyle=(0, (4, 3)), linewidth=0.8)
                named.setdefault(name, mark)
            axis.set(xlabel=panel.x, ylabel=panel.y, title=panel.title)
            width = linear_width([line.y for line in panel.lines]) if panel.compresses else None
            if width is not None:
                axis.set_yscale("asinh", linear_width=width)
                axis.set_yticks(_decades(axis.get_ylim(), width))
                axis.yaxis.set_major_formatter("{x:g}")
            if panel.ticks:
                axis.set_xticks(range(len(panel.ticks)), panel.ticks)
            largest = max((float(np.max(line.x)) for line in panel.lines if np.size(line.x)), default=0)
            if largest >= 10_000:
                axis.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        legend(figure, named)
        return figure


def linear_width(heights: Sequence[ArrayLike]) -> float | None:
    """Return up to which distance from 0 heights are drawn to scale, if some lie too far off to be drawn so.

    Args:
        heights: of each curve.

    Returns:
        The median of the curves' largest distances; ``None`` where the largest of all is less than ten times that.
    """
    furthest = [float(np.max(np.abs(own))) for own in heights if np.size(own)]
    width = float(np.median(furthest)) if furthest else 0.0
    return width if width and max(furthest) >= 10 * width else None


def _decades(limits: tuple[float, float], width: float) -> list[float]:
    """0 and the powers of ten on either side that stand apart from it on an axis to scale up to ``width``."""
    first, last = math.ceil(math.log10(width / 3)), math.floor(math.log10(max(map(abs, limits))))
    powers = [10.0**exponent for exponent in range(first, last + 1)]
    ticks = [*(-power for power in reversed(powers)), 0.0, *powers]
    return [tick for tick in ticks if limits[0] <= tick <= limits[1]]


def bars(groups: Sequence[str], series: Mapping[str, Sequence[float | None]], unit: str) -> Any:
    """Draw horizontal bars: a group of them per name, one per series, with their numbers.

    Args:
        groups: names, from top to bottom.
        series: label to a length per group; ``None`` leaves a gap.
        unit: of the lengths.
    """
    with theme():
        height = 0.45 + 0.24 * len(groups) * max(len(series), 2)
        figure, axes = make_figure(width=7.4, height=max(height, 2.0))
        axis = axes[0, 0]
        thickness = 0.8 / max(len(series), 1)
        shades = ("#0b80c3", "#8a9099", "#109e77", "#d9640a")
        for index, (label, lengths) in enumerate(series.items()):
            places = [
                row - 0.4 + thickness * (index + 0.5)
                for row, length in enumerate(lengths)
                if length is not None
            ]
            known = [length for length in lengths if length is not None]
            drawn = axis.barh(places, known, thickness * 0.9, color=shades[index % len(shades)], label=label)
            axis.bar_label(
                drawn, [f"{_short(length)}" for length in known], padding=3, fontsize=7.5, color=INK
            )
        axis.set_yticks(range(len(groups)), groups)
        axis.invert_yaxis()
        axis.grid(visible=False, axis="y")
        axis.set(xlabel=unit)
        axis.xaxis.set_major_formatter("{x:,g}")
        axis.margins(x=0.12)
        legend(figure, dict(zip(series, axis.containers)))
        return figure


def dots(
    rows: Sequence[str], panels: Sequence[tuple[str, Sequence[Dots]]], *, mark: float | None = None
) -> Any:
    """Draw systems as marks on shared rows, a panel per quantity.

    Args:
        rows: names, from top to bottom.
        panels: name of the quantity, with every system's marks.
        mark: place of an upright dashed line, e.g. where nothing has changed.

    Returns:
        Matplotlib's figure.
    """
    # A row has room for its systems' marks, one below the other.
    step = max(0.3, 0.075 * max((len(systems) for _, systems in panels), default=0))
    with theme():
        figure, axes = make_figure(
            1, len(panels), width=7.4 / len(panels) + 1.4, height=0.7 + step * len(rows)
        )
        named: dict[str, Any] = {}
        for place, (axis, (name, systems)) in enumerate(zip(axes[0], panels)):
            for index, system in enumerate(systems):
                # Equal values stand one below the other, in the order of the legend.
                offset = 0.7 * ((index + 0.5) / len(systems) - 0.5)
                drawn = axis.plot(
                    [math.nan if value is None else value for value in system.values],
                    [row + offset for row in range(len(rows))],
                    system.style.marker, color=system.style.color, markersize=4.5, linestyle="none",
                )  # fmt: skip
                named.setdefault(system.label, drawn[0])
            if mark is not None:
                axis.axvline(mark, color=INK, linestyle=(0, (4, 3)), linewidth=0.8)
            axis.set_yticks(range(len(rows)), rows if place == 0 else [""] * len(rows))
            axis.set_ylim(len(rows) - 0.5, -0.5)
            axis.set(xlabel=name)
            # Tiny ranges have long numbers; of more than five they touch.
            axis.locator_params(axis="x", nbins=5, min_n_ticks=3)
        legend(figure, named)
        return figure


def intervals(
    rows: Sequence[tuple[str, Style, float, tuple[float, float] | None]], unit: str, mark: float
) -> Any:
    """Draw one probability and its interval a row, against a mark that means no difference."""
    with theme():
        figure, axes = make_figure(width=6.4, height=max(0.9 + 0.3 * len(rows), 1.6))
        axis = axes[0, 0]
        for place, (_, style, value, ends) in enumerate(rows):
            if ends is not None:
                axis.plot(ends, (place, place), color=style.color, linewidth=2.2, alpha=0.55)
            axis.plot(value, place, marker=style.marker, color=style.color, markersize=6)
        axis.axvline(mark, color=INK, linestyle=(0, (4, 3)), linewidth=0.8)
        axis.set_yticks(range(len(rows)), [name for name, *_ in rows])
        axis.set_ylim(len(rows) - 0.5, -0.5)
        axis.set_xlim(-0.03, 1.03)
        axis.set(xlabel=unit)
        return figure


def scatter(
    clouds: Mapping[str, tuple[Style, np.ndarray]], names: Sequence[str], pairs: Sequence[tuple[int, int]]
) -> Any:
    """Draw points in several projections.

    Args:
        clouds: label to points ``[N, D]``.
        names: of the dimensions.
        pairs: which two dimensions each panel shows.
    """
    with theme():
        figure, axes = grid(len(pairs), 3, height=3.3)
        named: dict[str, Any] = {}
        for axis, (first, second) in zip(axes, pairs):
            for label, (style, points) in clouds.items():
                drawn = axis.plot(
                    points[:, first], points[:, second], style.marker, color=style.color, markersize=3.2,
                    alpha=0.65, markeredgewidth=0, linestyle="none",
                )  # fmt: skip
                named.setdefault(f"{label} ({len(points)} points)", drawn[0])
            axis.set(xlabel=names[first], ylabel=names[second])
        legend(figure, named)
        return figure


def strips(rows: Mapping[str, Sequence[np.ndarray]], *, size: float = 1.0) -> Any:
    """Show pictures ``[H, W, 3]`` in rows, each row with its name.

    Args:
        rows: name to its pictures, from left to right.
        size: of a picture's side in inches.
    """
    with theme():
        columns = max(len(pictures) for pictures in rows.values())
        figure, axes = make_figure(len(rows), columns, width=size, height=size * 1.05)
        for line, (name, pictures) in zip(axes, rows.items()):
            for axis in line:
                axis.set_axis_off()
            for axis, picture in zip(line, pictures):
                axis.imshow(picture, interpolation="nearest")
            line[0].set_title(name, fontsize=8)
        return figure


def _draw(axis: Any, line: Line) -> Any:
    x = np.asarray(line.x, dtype=float)
    style = line.style
    # A marker per point hides a long curve.
    every = max(len(x) // 12, 1)
    (drawn,) = axis.plot(
        x, line.y, color=style.color, marker=style.marker, linestyle=style.dashes, markersize=3.6, markevery=every,
        linewidth=1.5,
    )  # fmt: skip
    if line.low is not None and line.high is not None:
        axis.fill_between(x, line.low, line.high, color=style.color, alpha=0.18, linewidth=0)
    return drawn


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"

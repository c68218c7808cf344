"""Curves, marks and clouds of points, drawn from data frames without a window; every axis names its unit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

COLORS = {
    "crptpro": "#0b80c3", "crptpro-fast": "#3d44d8", "crptpro-finetune": "#5fc0f0", "proto-rl-c": "#d9640a",
    "proto-rl-s": "#e6a800", "atc": "#109e77", "apt-c": "#c76aa2", "apt-s": "#8a3f70", "becl": "#8f8a2a",
    "drq": "#8a7bd8", "random-encoder": "#858a91", "random policy": "#858a91",
}  # fmt: skip
"""Methods in the order of tables and legends; of Okabe and Ito's and of Tol's colour-blind-safe sets."""
OTHERS = ("#0b80c3", "#d9640a", "#109e77", "#c76aa2", "#8f8a2a", "#8a7bd8", "#e6a800", "#858a91", "#bb5566")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "*", "d")
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (3, 1, 1, 1, 1, 1)))
GREY, RULE = "#5d6672", "#d8dce1"


def base_method(label: str) -> str:
    """Return the method that a label is a variant of; empty if there is none.

    Examples:
        >>> base_method("proto-rl-c with dispersion"), base_method("crptpro-finetune"), base_method("mine")
        ('proto-rl-c', 'crptpro-finetune', '')
    """
    fitting = [m for m in COLORS if label == m or label.startswith((f"{m} ", f"{m},", f"{m}-"))]
    return max(fitting, key=len, default="")


def in_order(labels: Iterable[str]) -> list[str]:
    """Sort labels as tables show them: methods as the paper's, variants after their method, others last."""
    unique, order = list(dict.fromkeys(labels)), list(COLORS)

    def place(label: str) -> tuple[int, bool, int]:
        base = base_method(label)
        return (order.index(base) if base else len(order), label != base, unique.index(label))

    return sorted(unique, key=place)


def styles(labels: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return colour, marker and dash of labels; a variant has its method's colour and another marker and dash."""
    found: dict[str, dict[str, Any]] = {}
    unique = list(dict.fromkeys(labels))
    free = [color for color in OTHERS if color not in {COLORS.get(base_method(label)) for label in unique}]
    for label in unique:
        base = base_method(label)
        alike = sum(base_method(other) == base for other in found)
        place = (list(COLORS).index(base) if base else 0) + alike
        color = COLORS[base] if base else free[alike % len(free)]
        dashes, marker = DASHES[alike % len(DASHES)], MARKERS[place % len(MARKERS)]
        found[label] = {"color": color, "marker": marker, "linestyle": dashes}
    return found


def grid(count: int, most: int, *, width: float | None = None, height: float = 2.9) -> tuple[Any, list[Any]]:
    """Return a figure without a window and ``count`` axes, ``most`` side by side; sizes of a panel in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(count, most)
    rows = math.ceil(count / columns)
    width = width or {1: 7.4, 2: 5.2, 3: 3.9}.get(columns, 3.4)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes:
        axis.grid(visible=True, color=RULE, linewidth=0.6)
        axis.set_axisbelow(True)
        axis.tick_params(labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[count:]:
        axis.set_axis_off()
    return figure, axes[:count]


def curves(
    points: pd.DataFrame,
    x: str,
    y: str = "",
    *,
    marks: Mapping[str, Mapping[str, float]] | None = None,
    ticks: Sequence[str] = (),
    columns: int = 3,
) -> Any:
    """Draw curves in panels, with one legend below.

    Args:
        points: columns ``label``, ``x`` and ``y``; and, if there are such, ``panel`` (its title), ``line`` (which of a
            label's curves), ``n`` (runs, for the legend), ``low`` and ``high`` (an interval), ``thin``.
        x: name and unit of the horizontal axis.
        y: of the vertical one; empty where the titles say it.
        marks: title of a panel to heights of dashed lines, with what they say.
        ticks: names of the places 0, 1, ... of the horizontal axis, instead of numbers.
        columns: panels side by side.
    """
    usual = {"panel": "", "line": "", "n": np.nan, "low": np.nan, "high": np.nan, "thin": False}
    points = points.assign(**{name: value for name, value in usual.items() if name not in points})
    titles = list(dict.fromkeys(points["panel"]))
    figure, axes = grid(len(titles), columns)
    look = styles(in_order(points["label"]))
    counts = {label: _or(own["n"].dropna()) for label, own in points.groupby("label")}
    handles: dict[str, Any] = {}
    for axis, title in zip(axes, titles):
        here = points[points["panel"] == title]
        for (label, _), own in here.groupby(["label", "line"], sort=False):
            style = look[label]
            if own["thin"].all():
                axis.plot(own["x"], own["y"], color=style["color"], linewidth=0.5, alpha=0.7)
                continue
            size = {"linewidth": 1.5, "markersize": 4, "markevery": max(1, len(own) // 12)}
            (handle,) = axis.plot(own["x"], own["y"], **style, **size)
            handles.setdefault(f"{label} (n = {counts[label]})" if counts[label] else label, handle)
            if own["low"].notna().any():
                axis.fill_between(
                    own["x"], own["low"], own["high"], color=style["color"], alpha=0.15, linewidth=0
                )
        for name, at in (marks or {}).get(title, {}).items():
            handles.setdefault(name, axis.axhline(at, color=GREY, linestyle=(0, (4, 3)), linewidth=0.9))
        if ticks:
            axis.set_xticks(range(len(ticks)), ticks)
        axis.set_title(_literal(title), fontsize=9.5, loc="left")
        axis.set_xlabel(x, fontsize=8.5)
        axis.set_ylabel(y, fontsize=8.5)
    _legend(figure, handles)
    return figure


def dots(points: pd.DataFrame, *, mark: float | None = None, log: bool = False) -> Any:
    """Draw a mark per row and label, panels side by side.

    Args:
        points: columns ``panel`` (name and unit of the horizontal axis), ``row``, ``label`` and ``x``; ``low`` and
            ``high`` if there are intervals.
        mark: where a dashed line stands.
        log: whether distances are ratios.
    """
    from matplotlib.ticker import LogLocator

    titles, rows = (list(dict.fromkeys(points[name])) for name in ("panel", "row"))
    figure, axes = grid(len(titles), len(titles), height=0.9 + 0.24 * len(rows))
    look = styles(in_order(points["label"]))
    handles: dict[str, Any] = {}
    for axis, title in zip(axes, titles):
        here = points[points["panel"] == title]
        labels = list(dict.fromkeys(here["label"]))
        for place, label in enumerate(labels):
            own = here[here["label"] == label]
            # Marks of one row stand a little below each other.
            offset = (place - (len(labels) - 1) / 2) * min(0.08, 0.6 / len(labels))
            at = [rows.index(row) + offset for row in own["row"]]
            (handle,) = axis.plot(
                own["x"], at, **look[label] | {"linestyle": "none"}, markersize=5, alpha=0.9
            )
            handles.setdefault(label, handle)
            if "low" in own:
                axis.hlines(at, own["low"], own["high"], color=look[label]["color"], linewidth=1.5)
        if mark is not None:
            axis.axvline(mark, color=GREY, linestyle=(0, (4, 3)), linewidth=0.9)
        axis.set_yticks(range(len(rows)), [_literal(row) if axis is axes[0] else "" for row in rows])
        axis.set_ylim(len(rows) - 0.4, -0.6)
        axis.locator_params(axis="x", nbins=5)
        if log:
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter("")
        axis.set_xlabel(title, fontsize=8.5)
    _legend(figure, handles)
    return figure


def scatter(points: pd.DataFrame, components: Sequence[str]) -> Any:
    """Draw clouds of points, a panel per pair of components.

    Args:
        points: columns ``label`` and one per component, in order.
        components: names of the axes.
    """
    numbers = [name for name in points if name != "label"][: len(components)]
    pairs = list(combinations(range(len(numbers)), 2))
    figure, axes = grid(len(pairs), 3)
    handles: dict[str, Any] = {}
    for label, style in styles(points["label"]).items():
        own = points[points["label"] == label]
        for axis, (x, y) in zip(axes, pairs):
            handles[label] = axis.scatter(
                own[numbers[x]], own[numbers[y]], s=9, alpha=0.6, color=style["color"]
            )
            axis.set(xlabel=components[x], ylabel=components[y])
    _legend(figure, handles)
    return figure


def _legend(figure: Any, named: Mapping[str, Any]) -> None:
    """Draw one legend for all panels below them; the figure grows by what it takes."""
    if not named:
        return
    width, height = figure.get_size_inches()
    columns = max(1, min(len(named), int(width / (0.6 + 0.062 * max(map(len, named))))))
    figure.set_size_inches(width, height + 0.17 * math.ceil(len(named) / columns) + 0.1)
    texts = [_literal(name) for name in named]
    figure.legend(named.values(), texts, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def _literal(name: Any) -> str:
    """A name in dollars is a name, not mathematics."""
    return str(name).replace("$", r"\$")


def _or(values: Iterable[float]) -> str:
    return " or ".join(f"{value:,.0f}" for value in sorted(set(values)))

"""Small multiples with one legend, drawn from data frames without a display; every axis names its unit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from crptpro.experiments.matrix import METHODS

COLORS = {
    "crptpro": "#0b80c3", "crptpro-fast": "#3d44d8", "crptpro-no-bonus": "#1d2733", "crptpro-finetune": "#5fc0f0",
    "proto-rl-c": "#d9640a", "proto-rl-s": "#e6a800", "atc": "#109e77", "apt-c": "#c76aa2", "apt-s": "#8a3f70",
    "becl": "#8f8a2a", "drq": "#8a7bd8", "random-encoder": "#858a91", "random-encoder-standardised": "#7a4a1e",
    "random policy": "#858a91",
}  # fmt: skip
"""From Okabe and Ito's and from Tol's colour-blind-safe sets; methods that are not listed take matplotlib's."""
ORDER = (*METHODS, "random policy")  # of tables and legends
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "*", "d")
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (3, 1, 1, 1, 1, 1)))
GREY, RULE = "#5d6672", "#d8dce1"


def base_method(label: str) -> str:
    """Return the method that a label is a variant of; empty if there is none.

    Examples:
        >>> base_method("proto-rl-c with dispersion"), base_method("crptpro-finetune"), base_method("mine")
        ('proto-rl-c', 'crptpro-finetune', '')
    """
    fitting = [m for m in ORDER if label == m or label.startswith((f"{m} ", f"{m},", f"{m}-"))]
    return max(fitting, key=len, default="")


def in_order(labels: Iterable[str]) -> list[str]:
    """Sort labels as tables show them: methods in the paper's order, variants after their method, others last."""
    order = [*ORDER, ""]
    return sorted(dict.fromkeys(labels), key=lambda label: (order.index(base_method(label)), label not in order))


def styles(labels: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return colour, marker and dash of labels; a variant has its method's colour and another marker and dash."""
    found: dict[str, dict[str, Any]] = {}
    for place, label in enumerate(in_order(labels)):
        color = COLORS.get(base_method(label), f"C{place % 10}")
        alike = sum(style["color"] == color for style in found.values())
        marker, dash = MARKERS[place % len(MARKERS)], DASHES[alike % len(DASHES)]
        found[label] = {"color": color, "marker": marker, "linestyle": dash}
    return found


def draw(
    points: pd.DataFrame, x: str = "", y: str = "", *, kind: str = "line", marks: Mapping[str, float] | None = None
) -> Any:
    """Draw panels with one legend below.

    ``points`` has columns ``label``, ``x`` (numbers, or ordered names) and ``y``; optionally ``panel`` (its title),
    ``line`` (one of a label's curves), ``n`` (runs, for the legend), ``low`` and ``high`` (an interval), and ``thin``
    (a thin line without legend). ``x`` and ``y`` name the axes and their units. ``kind`` is ``"line"``, or ``"cloud"``
    of points. ``marks`` maps names to the heights of dashed lines in the first panel.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    optional = {"panel": "", "line": "", "n": "", "low": math.nan, "high": math.nan, "thin": False}
    points = points.assign(**{name: value for name, value in optional.items() if name not in points})
    panels = points["panel"].nunique()
    columns = 2 if panels == 4 else min(panels, 3)
    rows = math.ceil(panels / columns)
    height = 2.9
    width = {1: 7.4, 2: 5.2}.get(columns, 3.9)
    look = styles(points["label"])
    handles: dict[str, Any] = {}
    counts = {label: " or ".join(map(str, sorted(set(own)))) for label, own in points.groupby("label")["n"]}
    with mpl.rc_context({"text.parse_math": False}):  # a user's name in dollars is a name
        figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axis, (panel, here) in zip(axes, points.groupby("panel", sort=False)):
            for (label, _), own in here.groupby(["label", "line"], sort=False):
                style = look[label]
                if own["thin"].all():
                    axis.plot(own["x"], own["y"], color=style["color"], linewidth=0.5, alpha=0.7)
                    continue
                if kind == "cloud":
                    style = {**style, "linestyle": "none", "alpha": 0.6}
                spaced = max(1, len(own) // 12) if kind == "line" else 1
                (handle,) = axis.plot(own["x"], own["y"], **style, linewidth=1.5, markersize=4, markevery=spaced)
                handles.setdefault(f"{label} (n = {counts[label]})" if counts[label] else label, handle)
                if own["low"].notna().any():
                    axis.fill_between(own["x"], own["low"], own["high"], color=style["color"], alpha=0.15)
            axis.set_title(panel, fontsize=9.5, loc="left")
            axis.set_xlabel(x, fontsize=8.5)
            axis.set_ylabel(y, fontsize=8.5)
            axis.grid(visible=True, color=RULE, linewidth=0.6)
            axis.tick_params(labelsize=8)
            axis.spines[["top", "right"]].set_visible(False)
        for name, at in (marks or {}).items():
            handles[name] = axes[0].axhline(at, color=GREY, linestyle=(0, (4, 3)), linewidth=0.9)
        for axis in axes[panels:]:
            axis.set_axis_off()
        across = max(1, min(len(handles), int(width * columns / (0.6 + 0.062 * max(map(len, handles))))))
        figure.set_figheight(height * rows + 0.17 * math.ceil(len(handles) / across) + 0.1)
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=across, fontsize=8, frameon=False)
    return figure

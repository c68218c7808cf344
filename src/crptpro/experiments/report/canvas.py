"""What all drawings of a report share: colours, look, places for panels, the legend below them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

from crptpro.experiments.plots import make_figure

INK, PAPER, RULE = "#1f2328", "#fefefd", "#d8dce1"
"""Text, background and grid of the files; inline in a page they are the page's own."""


@contextlib.contextmanager
def theme() -> Iterator[None]:
    """Draw and save with this report's look."""
    import matplotlib

    look: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": "crptpro",  # the same numbers give the same file
        "font.size": 9,
        "text.color": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK, "axes.edgecolor": INK,
        "figure.facecolor": PAPER, "axes.facecolor": PAPER, "savefig.facecolor": PAPER,
        "axes.grid": True, "grid.color": RULE, "grid.linewidth": 0.6, "axes.axisbelow": True,
        "axes.spines.top": False, "axes.spines.right": False,
        "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.titleweight": "bold",
        "legend.frameon": False,
        "axes.formatter.useoffset": False,
    }  # fmt: skip
    with matplotlib.rc_context(look):
        yield


def grid(panels: int, most: int, *, height: float = 2.9) -> tuple[Any, list[Any]]:
    """Return a figure and its axes, one per panel.

    Args:
        panels: how many.
        most: side by side.
        height: of a panel, in inches.
    """
    columns = min(panels, most)
    width = {1: 7.4, 2: 5.2}.get(columns, 3.7)
    figure, axes = make_figure(math.ceil(panels / columns), columns, width=width, height=height)
    flat = list(axes.flat)
    for axis in flat[panels:]:
        axis.set_axis_off()
    return figure, flat


def legend(figure: Any, named: Mapping[str, Any]) -> None:
    """One legend for all panels, below them; the figure grows by what it takes."""
    if not named:
        return
    width, height = figure.get_size_inches()
    entry = 0.6 + 0.062 * max(len(name) for name in named)  # inches
    columns = max(1, min(len(named), int(width / entry)))
    rows = math.ceil(len(named) / columns)
    figure.set_size_inches(width, height + 0.17 * rows + 0.1)
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=columns, fontsize=8)

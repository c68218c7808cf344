"""Figures as files, and as parts of a page."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

from crptpro.experiments.report.canvas import INK, PAPER, RULE, theme
from crptpro.whole_file import write_whole


def save(drawing: Any, folder: Path, name: str) -> tuple[str, bytes]:
    """Write a figure as PNG and as SVG.

    Returns:
        The SVG as it can stand inside a page, and the PNG.

    Raises:
        OSError: a file cannot be written; it names the path.
    """
    text, pixels = io.StringIO(), io.BytesIO()
    with theme():
        drawing.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
        drawing.set_layout_engine("none")  # the same places in both files, and the layout is most of the work
        drawing.savefig(pixels, format="png", dpi=144, metadata={"Software": None})
    write_whole(folder / f"{name}.svg", text.getvalue())
    write_whole(folder / f"{name}.png", pixels.getvalue())
    return inline_svg(text.getvalue(), name), pixels.getvalue()


def inline_svg(text: str, name: str) -> str:
    """Make an SVG part of a page: the page's colours, names that no other figure has, a width that can shrink.

    Args:
        text: of matplotlib's file.
        name: unique in the page.
    """
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    prefix = re.sub(r"[^a-zA-Z0-9]+", "-", name)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'\bhref="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    for color, page in ((INK, "currentColor"), (PAPER, "none"), (RULE, "var(--rule)")):
        text = text.replace(color, page)
    tag, rest = text.split(">", 1)
    width = re.search(r'\bwidth="([\d.]+)pt"', tag)
    pixels = (float(width[1]) if width else 480.0) * 4 / 3
    tag = re.sub(r'\s(width|height)="[^"]*"', "", tag)
    # Below three quarters its letters are too small to read: then it scrolls.
    return f'{tag} style="width:{pixels:.0f}px;min-width:{0.75 * pixels:.0f}px">{rest}'

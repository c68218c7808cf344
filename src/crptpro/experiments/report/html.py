"""A report as one HTML file that needs nothing else: no network, no script, no other file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from html import escape
from typing import NamedTuple

from crptpro.experiments.report.blocks import (
    Block,
    Bullets,
    Cell,
    Figure,
    Fold,
    Heading,
    Page,
    Paragraph,
    Section,
    Table,
)
from crptpro.experiments.report.style import CSS

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""What a browser is told that the page may load: what is inside it."""
MANY = 9
"""Tables of more columns are set closer."""


class Saved(NamedTuple):
    """A figure as it enters pages.

    Args:
        svg: inline, with the page's colours.
        png: the file's bytes.
    """

    svg: str
    png: bytes


def html_page(page: Page, figures: Mapping[str, Saved]) -> str:
    """Lay a report out as HTML.

    Args:
        page: what it says.
        figures: name to the figure as it was saved.
    """
    contents = "".join(f'<li><a href="#{escape(s.anchor)}">{escape(s.title)}</a></li>' for s in page.sections)
    sections = "\n".join(_section(section, figures) for section in page.sections)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{escape(page.title)}</title>
<style>{CSS}</style>
</head>
<body>
<header><h1>{escape(page.title)}</h1>
<p>{escape(page.summary)}</p></header>
<nav aria-label="Contents"><ul>{contents}</ul></nav>
<main>
{sections}
</main>
<footer>One file; the same tables are in report.md, the figures as PNG and SVG in figures/.</footer>
</body>
</html>
"""


def _section(section: Section, figures: Mapping[str, Saved]) -> str:
    blocks = "\n".join(_block(block, figures) for block in section.blocks)
    return f'<section id="{escape(section.anchor)}">\n<h2>{escape(section.title)}</h2>\n{blocks}\n</section>'


def _block(block: Block, figures: Mapping[str, Saved]) -> str:
    renderers: dict[type, Callable[..., str]] = {
        Heading: lambda block: f"<h3>{escape(block.text)}</h3>",
        Paragraph: _paragraph,
        Bullets: _bullets,
        Table: _table,
    }
    if isinstance(block, Figure):
        return _figure(block, figures[block.name])
    if isinstance(block, Fold):
        inside = "\n".join(_block(part, figures) for part in block.blocks)
        anchor = f' id="{escape(block.anchor)}"' if block.anchor else ""
        return f"<details{anchor}><summary>{escape(block.title)}</summary>\n{inside}\n</details>"
    return renderers[type(block)](block)


def _paragraph(block: Paragraph) -> str:
    kind = "" if block.tone == "plain" else f' class="{block.tone}"'
    return f"<p{kind}>{escape(block.text)}</p>"


def _bullets(block: Bullets) -> str:
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in block.items) + "</ul>"


def _table(block: Table) -> str:
    head = "".join(
        f'<th scope="col"{_name(index, block)}>{_words(column)}</th>'
        for index, column in enumerate(block.columns)
    )
    body = "\n".join(
        "<tr>" + "".join(_cell(cell, index, block) for index, cell in enumerate(row)) + "</tr>"
        for row in block.rows
    )
    # Facts hold sentences and paths, tables of numbers must not break.
    longest = max((len(cell.text) for row in block.rows for cell in row), default=0)
    looks = ["wide"] * (longest > 40) + ["many"] * (len(block.columns) > MANY)
    look = f' class="{" ".join(looks)}"' if looks else ""
    return (
        f'<figure class="table"><figcaption>{escape(block.caption)}</figcaption><div class="sheet" tabindex="0" '
        f'role="region" aria-label="{escape(block.caption)}"><table{look}>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div></figure>"
    )


def _words(heading: str) -> str:
    """A heading may break between words, and not at the hyphens of a method's name."""
    return " ".join(f"<span>{escape(word)}</span>" for word in heading.split())


def _name(index: int, block: Table) -> str:
    longest = max((len(row[index].text) for row in block.rows), default=0)
    return ' class="name"' if index < block.labels or longest > 40 else ""


def _cell(cell: Cell, index: int, block: Table) -> str:
    text = escape(cell.text)
    if cell.anchor:
        text = f'<a href="#{escape(cell.anchor)}">{text}</a>'
    below = "".join(
        f"<small>{escape(line)}</small>"
        for line in (cell.beside, f"paper {cell.published}" if cell.published else "")
        if line
    )
    tag, scope = ("th", ' scope="row"') if index < block.labels else ("td", "")
    return f"<{tag}{scope}{_name(index, block)}>{text}{below}</{tag}>"


def _figure(block: Figure, saved: Saved) -> str:
    label = escape(block.caption)
    if block.is_photo:
        data = base64.b64encode(saved.png).decode()
        inside = f'<img alt="{label}" src="data:image/png;base64,{data}">'
    else:
        inside = saved.svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return (
        f'<figure class="drawing"><div class="sheet">{inside}</div><figcaption>{label}</figcaption></figure>'
    )

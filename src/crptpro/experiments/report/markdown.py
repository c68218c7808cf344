"""The same report as Markdown beside its figures."""

from __future__ import annotations

from crptpro.experiments.markdown import markdown_table
from crptpro.experiments.report.blocks import (
    Block,
    Bullets,
    Cell,
    Figure,
    Fold,
    Heading,
    Page,
    Paragraph,
    Table,
)


def markdown_page(page: Page, *, figures: str = "figures") -> str:
    """Lay a report out as Markdown.

    Args:
        page: what it says.
        figures: directory of the pictures, relative to the file.
    """
    parts = [f"# {_text(page.title)}", _text(page.summary)]
    for section in page.sections:
        parts.append(f"## {_text(section.title)}")
        parts += [_block(block, figures) for block in section.blocks]
    return "\n\n".join(part for part in parts if part) + "\n"


def _block(block: Block, figures: str) -> str:
    if isinstance(block, Heading):
        return f"### {_text(block.text)}"
    if isinstance(block, Paragraph):
        text = _text(block.text)
        return f"> {text}" if block.tone == "warning" else text
    if isinstance(block, Bullets):
        return "\n".join(f"- {_text(item)}" for item in block.items)
    if isinstance(block, Figure):
        return f"![{_text(block.caption)}]({figures}/{block.name}.png)\n\n{_text(block.caption)}"
    if isinstance(block, Fold):
        inside = "\n\n".join(_block(part, figures) for part in block.blocks)
        return f"<details><summary>{_text(block.title)}</summary>\n\n{inside}\n\n</details>"
    return _table(block)


def _table(block: Table) -> str:
    rows = [dict(zip(map(_text, block.columns), map(_cell, row))) for row in block.rows]
    return f"**{_text(block.caption)}**\n\n{markdown_table(rows)}"


def _cell(cell: Cell) -> str:
    published = f"paper {cell.published}" if cell.published else ""
    return _text(" · ".join(part for part in (cell.text, cell.beside, published) if part))


def _text(text: str) -> str:
    """Names come from files: nothing of theirs becomes markup or ends a line."""
    return " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;")

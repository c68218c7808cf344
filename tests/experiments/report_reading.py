"""Reading a report back: blocks by caption, cells by row and column, HTML by a parser."""

from __future__ import annotations

from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.report.blocks import Block, Cell, Fold, Page, Table
from crptpro.experiments.report.page import make_page
from crptpro.experiments.report.reading import read_source


def page_of(root: Path, replicates: int = 100) -> Page:
    return make_page(read_source(root), Bootstrap(replicates=replicates))


def blocks_of(page: Page, anchor: str) -> tuple[Block, ...]:
    (section,) = [section for section in page.sections if section.anchor == anchor]
    return section.blocks


def tables_in(blocks: tuple[Block, ...]) -> Iterator[Table]:
    for block in blocks:
        if isinstance(block, Table):
            yield block
        elif isinstance(block, Fold):
            yield from tables_in(block.blocks)


def table_in(blocks: tuple[Block, ...], caption: str) -> Table:
    found = [table for table in tables_in(blocks) if caption in table.caption]
    assert len(found) == 1, [table.caption for table in tables_in(blocks)]
    return found[0]


def cell(table: Table, column: str, *names: str) -> Cell:
    """The cell of a column, in the one row whose first cells have these names."""
    rows = [row for row in table.rows if tuple(c.text for c in row[: len(names)]) == names]
    assert len(rows) == 1, [[c.text for c in row] for row in table.rows]
    return rows[0][table.columns.index(column)]


def words(blocks: tuple[Block, ...]) -> str:
    """Everything that blocks say outside tables."""
    found = []
    for block in blocks:
        if isinstance(block, Fold):
            found += [block.title, words(block.blocks)]
        else:
            items = getattr(block, "items", ())
            found += [getattr(block, "text", ""), getattr(block, "caption", ""), *items]
    return "\n".join(found)


class Parsed(HTMLParser):
    """What a page is made of.

    Args:
        text: of the page.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.rows: list[list[str]] = []
        self._open = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster"):
                self.references.append(value or "")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._open = True
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th"):
            self._open = False

    def handle_data(self, data: str) -> None:
        if self._open:
            self.rows[-1][-1] += f" {data}" if self.rows[-1][-1] else data

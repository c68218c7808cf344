"""What a report is made of, before it becomes HTML or Markdown."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

ABSENT = "\N{EN DASH}"
"""What a cell shows where there is no number."""


@dataclass(frozen=True)
class Heading:
    """The title of a part of a section."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """A few sentences.

    Args:
        text: plain; renderers escape it.
        tone: ``"warning"`` for what a reader must not miss, ``"note"`` for what explains a table or a figure.
    """

    text: str
    tone: Literal["plain", "note", "warning"] = "plain"


@dataclass(frozen=True)
class Bullets:
    """Short statements, one below the other."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Args:
        text: the number, or a name.
        beside: what stands with it in a second line: an interval, a number of runs.
        published: the paper's number for the same thing.
        anchor: of the fold that tells more; empty for none.
    """

    text: str
    beside: str = ""
    published: str = ""
    anchor: str = ""


@dataclass(frozen=True)
class Table:
    """Rows under named columns.

    Args:
        caption: what the numbers are, with their unit.
        columns: names, no two alike.
        rows: one cell per column.
        labels: how many columns at the left name the row.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    labels: int = 1

    def __post_init__(self) -> None:
        """Refuse a table whose cells and columns do not match.

        Raises:
            ValueError: naming the table.
        """
        if len(set(self.columns)) != len(self.columns):
            raise ValueError(f"Two columns of {self.caption!r} have one name: {self.columns}.")
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"{self.caption!r} has {len(self.columns)} columns, a row has {len(row)}.")


@dataclass(frozen=True)
class Figure:
    """A drawing.

    Args:
        name: of its files, unique in the report.
        caption: what is drawn, over how many runs.
        drawing: matplotlib's figure.
        is_photo: it shows pictures; it is embedded as pixels and not as lines.
    """

    name: str
    caption: str
    drawing: Drawing
    is_photo: bool = False


@dataclass(frozen=True)
class Fold:
    """Details that are closed until somebody opens them: a card, a list of what is missing.

    Args:
        title: always visible.
        blocks: visible when opened.
        anchor: for links, unique in the report; empty for none.
    """

    title: str
    blocks: tuple[Block, ...]
    anchor: str = ""


Block = Heading | Paragraph | Bullets | Table | Figure | Fold


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it."""

    title: str
    blocks: tuple[Block, ...]
    anchor: str


@dataclass(frozen=True)
class Page:
    """The whole report.

    Args:
        title: heading.
        summary: what this is, when it was made.
        sections: in order.
    """

    title: str
    summary: str
    sections: tuple[Section, ...]


def cells(*values: str | Cell) -> tuple[Cell, ...]:
    """Return a row of a table.

    Examples:
        >>> cells("walker_run", Cell("512", published="513 ± 33"))[0].text
        'walker_run'
    """
    return tuple(value if isinstance(value, Cell) else Cell(value) for value in values)


def sentence(text: str) -> str:
    """Return a text with a capital at its beginning.

    Examples:
        >>> sentence("group A: diagnostics.")
        'Group A: diagnostics.'
    """
    return text[:1].upper() + text[1:]


def counted(number: int, noun: str) -> str:
    """Return a number of things.

    Examples:
        >>> counted(1, "run"), counted(1_200, "piece")
        ('1 run', '1,200 pieces')
    """
    return f"{number:,} {noun}{'s' * (number != 1)}"


def numbered(counts: Collection[int]) -> str:
    """Return how many draws numbers stand on.

    Examples:
        >>> numbered([2, 2]), numbered({1, 3})
        ('n = 2', 'n = 1 to 3')
    """
    low, high = min(counts, default=0), max(counts, default=0)
    return f"n = {low}" if low == high else f"n = {low} to {high}"


def facts(caption: str, pairs: dict[str, str]) -> Table:
    """Return a table of names and values."""
    return Table(
        caption, ("what", "value"), tuple(cells(name, value) for name, value in pairs.items()), labels=2
    )


def figures_of(blocks: tuple[Block, ...]) -> list[Figure]:
    """Return every figure among blocks, folded ones too."""
    found = []
    for block in blocks:
        if isinstance(block, Figure):
            found.append(block)
        elif isinstance(block, Fold):
            found += figures_of(block.blocks)
    return found

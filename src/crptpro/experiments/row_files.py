"""Measurements as CSV files: written whole or not at all."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from crptpro.errors import RecordError
from crptpro.whole_file import write_whole


def write_rows(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> Path:
    """Write rows under a header; what was there before is replaced once everything is written.

    Args:
        path: of the file; its directory is made.
        columns: in order; a row may lack some of them, but has no others.
        rows: column name to value.

    Returns:
        ``path``.

    Raises:
        DiskSpaceError: if the disk is full; what was there before is kept.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return write_whole(path, text.getvalue())


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read a CSV file with a header.

    Raises:
        RecordError: there is no such file, or it cannot be read.
    """
    path = Path(path)
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except FileNotFoundError:
        raise RecordError(f"{path.parent.name} has no {path.name}.") from None
    except (OSError, UnicodeDecodeError, csv.Error) as reason:
        raise RecordError(f"{path} cannot be read: {reason}.") from None

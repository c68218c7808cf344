"""Measurements as CSV files: written whole or not at all."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from crptpro.errors import RecordError, writing_error


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
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with open(partial, "w", newline="") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        partial.replace(path)
    except BaseException as reason:
        partial.unlink(missing_ok=True)
        if isinstance(reason, OSError):
            raise writing_error(path, reason) from reason
        raise
    return path


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

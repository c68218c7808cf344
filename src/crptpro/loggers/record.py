"""The local record of a run: one JSONL file with everything, and a CSV per stream derived from it."""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from crptpro.errors import writing_error
from crptpro.whole_file import write_whole

_LOG = logging.getLogger(__name__)

Scalar = int | float | str
JSONL_NAME = "metrics.jsonl"
RESERVED = ("stream", "unix_time_s")


class MetricRecord:
    """Rows of metrics on disk, complete after every call, also when the process is killed in between.

    ``metrics.jsonl`` is the master; ``<stream>.csv`` is rebuilt from it whenever the two disagree, when a new
    column appears, and when rows are taken back.

    Args:
        run_dir: directory of the run, created if missing. Rows found there are continued.
    """

    def __init__(self, run_dir: str | Path) -> None:
        self.run_dir = Path(run_dir)
        self.run_dir.mkdir(parents=True, exist_ok=True)
        self.path = self.run_dir / JSONL_NAME
        self._columns: dict[str, list[str]] = {}
        self._counts: dict[str, int] = {}
        rows = self._read()
        for row in rows:
            self._register(row)
        for stream in self._columns:
            if not self._csv_agrees(stream):
                self._write_csv(stream, rows)

    @property
    def total_rows(self) -> int:
        """Number of rows of all streams."""
        return sum(self._counts.values())

    def append(self, stream: str, counters: Mapping[str, int], metrics: Mapping[str, Scalar]) -> None:
        """Write one row.

        Raises:
            DiskSpaceError: if the disk is full; no half row stays behind.
        """
        row = {"stream": stream, **counters, "unix_time_s": round(time.time(), 3), **metrics}
        is_known = set(row) <= {"stream", *self._columns.get(stream, ())}
        self._append_line(self.path, json.dumps(_json_row(row)) + "\n")
        self._register(row)
        if is_known and self.csv_path(stream).exists():
            line = io.StringIO()
            csv.writer(line, lineterminator="\n").writerow([_cell(row.get(c)) for c in self._columns[stream]])
            self._append_line(self.csv_path(stream), line.getvalue())
        else:
            self._write_csv(stream, self._read())

    def csv_path(self, stream: str) -> Path:
        """Return the CSV file of a stream."""
        return self.run_dir / f"{stream}.csv"

    def rows(self, stream: str) -> list[dict[str, Any]]:
        """Return the rows of a stream in order, without the stream's name."""
        found = [row for row in self._read() if row["stream"] == stream]
        return [{key: value for key, value in row.items() if key != "stream"} for row in found]

    def counts(self, streams: Iterable[str] | None = None) -> dict[str, int]:
        """Return the number of rows per stream, for those asked or all."""
        names = self._counts if streams is None else streams
        return {name: self._counts.get(name, 0) for name in names}

    def sync(self) -> None:
        """Force the record to disk, so that a checkpoint never counts rows that a power loss takes away."""
        if self.path.exists():
            with open(self.path, "rb") as file:
                os.fsync(file.fileno())

    def keep_first(self, counts: Mapping[str, int], *, only_these: bool) -> None:
        """Take back every row of a stream beyond its count.

        Args:
            counts: rows to keep per stream.
            only_these: leave streams not named alone; otherwise they are taken back whole.
        """
        seen: dict[str, int] = {}
        kept = []
        for row in self._read():
            stream = row["stream"]
            seen[stream] = seen.get(stream, 0) + 1
            limit = counts.get(stream, math.inf if only_these else 0)
            if seen[stream] <= limit:
                kept.append(row)
        for stream, count in counts.items():
            if seen.get(stream, 0) < count:
                _LOG.warning(
                    "%s has %d rows of %r, the checkpoint counted %d: the record was edited or lost rows.",
                    self.path, seen.get(stream, 0), stream, count,
                )  # fmt: skip
        self._replace_rows(kept)

    def keep_until(self, stream: str, counter: str, value: int) -> None:
        """Take back every row of ``stream`` whose ``counter`` exceeds ``value``."""
        self._replace_rows([r for r in self._read() if r["stream"] != stream or r.get(counter, 0) <= value])

    def _register(self, row: Mapping[str, Any]) -> None:
        stream = row["stream"]
        columns = self._columns.setdefault(stream, [])
        columns.extend(key for key in row if key != "stream" and key not in columns)
        self._counts[stream] = self._counts.get(stream, 0) + 1

    def _read(self) -> list[dict[str, Any]]:
        """All rows; a torn or foreign line is dropped from the file with a warning."""
        if not self.path.exists():
            return []
        rows, damaged = [], 0
        with open(self.path, encoding="utf-8", errors="replace") as file:
            for line in file:
                try:
                    row = json.loads(line)
                except json.JSONDecodeError:
                    row = None
                if isinstance(row, dict) and isinstance(row.get("stream"), str) and line.endswith("\n"):
                    rows.append(row)
                else:
                    damaged += 1
        if damaged:
            _LOG.warning("%s: dropped %d damaged line(s).", self.path, damaged)
            self._write_jsonl(rows)
        return rows

    def _replace_rows(self, rows: list[dict[str, Any]]) -> None:
        before = set(self._columns)
        if len(rows) == self.total_rows:
            return
        self._write_jsonl(rows)
        self._columns, self._counts = {}, {}
        for row in rows:
            self._register(row)
        for stream in before:
            if stream in self._columns:
                self._write_csv(stream, rows)
            else:
                self.csv_path(stream).unlink(missing_ok=True)

    def _csv_agrees(self, stream: str) -> bool:
        path = self.csv_path(stream)
        if not path.exists():
            return False
        text = path.read_text(encoding="utf-8", errors="replace")
        header = text.split("\n", 1)[0]
        is_whole = text.endswith("\n") and text.count("\n") == self._counts[stream] + 1
        return is_whole and header == ",".join(self._columns[stream])

    def _write_csv(self, stream: str, rows: Iterable[Mapping[str, Any]]) -> None:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self._columns[stream])
        for row in rows:
            if row["stream"] == stream:
                writer.writerow([_cell(row.get(column)) for column in self._columns[stream]])
        write_whole(self.csv_path(stream), text.getvalue())

    def _write_jsonl(self, rows: Iterable[Mapping[str, Any]]) -> None:
        write_whole(self.path, "".join(json.dumps(_json_row(row)) + "\n" for row in rows))

    @staticmethod
    def _append_line(path: Path, line: str) -> None:
        size = path.stat().st_size if path.exists() else 0
        try:
            with open(path, "a", encoding="utf-8") as file:
                file.write(line)
        except OSError as reason:
            if path.exists():
                os.truncate(path, size)
            raise writing_error(path, reason) from reason


def _json_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """NaN and infinity become words: they are not JSON, and the CSV shows the same."""
    return {key: _cell(value) if isinstance(value, float) else value for key, value in row.items()}


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value

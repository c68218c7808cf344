from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from crptpro.errors import DiskSpaceError, RecordError
from crptpro.experiments.row_files import read_rows, write_rows


def test_rows_come_back_as_text_and_what_a_row_lacks_is_empty(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "new" / "a.csv", ("x", "y"), [{"y": 1.5, "x": "a, b"}, {"x": 2}])
    assert path.read_text() == 'x,y\n"a, b",1.5\n2,\n'
    assert read_rows(path) == [{"x": "a, b", "y": "1.5"}, {"x": "2", "y": ""}]


def test_a_file_is_kept_if_its_successor_cannot_be_written(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.csv", ("x",), [{"x": 1}])

    def interrupted() -> Iterator[dict[str, int]]:
        yield {"x": 2}
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_rows(path, ("x",), interrupted())
    assert read_rows(path) == [{"x": "1"}]


def test_a_full_disk_is_named_and_nothing_torn_stays(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.csv", ("x",), [{"x": 1}])
    (tmp_path / f".a.csv.{os.getpid()}.partial").symlink_to("/dev/full")
    with pytest.raises(DiskSpaceError, match=r"disk is full: .*/a\.csv cannot be written"):
        write_rows(path, ("x",), [{"x": 2}])
    assert read_rows(path) == [{"x": "1"}]
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"has no a\.csv"):
        read_rows(tmp_path / "a.csv")

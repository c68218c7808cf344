"""Small files, written whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from crptpro.errors import DiskSpaceError
from crptpro.experiments.markdown import write_report
from crptpro.experiments.report import figures
from crptpro.experiments.report.canvas import theme
from crptpro.whole_file import write_whole


def fill_disk_at(path: Path) -> None:
    """The file that is written beside ``path`` takes nothing."""
    path.with_name(f".{path.name}.{os.getpid()}.partial").symlink_to("/dev/full")


@pytest.mark.parametrize("content", ["caf\N{LATIN SMALL LETTER E WITH ACUTE}\r\n", b"\x00\xff"])
def test_what_is_written_is_read_with_its_directory_made_and_rights_as_usual(
    tmp_path: Path, content: str | bytes
) -> None:
    path = write_whole(tmp_path / "made" / "a.txt", content)
    assert path.read_bytes() == (content if isinstance(content, bytes) else content.encode())
    usual = tmp_path / "usual"
    usual.touch()
    assert path.stat().st_mode == usual.stat().st_mode
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]


def test_a_full_disk_is_named_and_what_was_there_is_kept(tmp_path: Path) -> None:
    path = write_whole(tmp_path / "a.txt", "before")
    fill_disk_at(path)
    with pytest.raises(DiskSpaceError, match=r"disk is full: .*/a\.txt cannot be written"):
        write_whole(path, "after")
    assert path.read_text() == "before"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_a_failure_of_another_kind_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(handle: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr("crptpro.whole_file.os.fsync", broken)
    with pytest.raises(OSError, match=r"Input/output error: '.*/a\.txt'"):
        write_whole(tmp_path / "a.txt", "after")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_a_figure_for_which_the_disk_is_full_is_named(tmp_path: Path, suffix: str) -> None:
    fill_disk_at(tmp_path / f"spread.{suffix}")
    with theme():
        from matplotlib.figure import Figure

        with pytest.raises(DiskSpaceError, match=rf"spread\.{suffix} cannot be written"):
            figures.save(Figure(), tmp_path, "spread")


def test_a_report_for_which_the_disk_is_full_is_named_and_the_older_one_kept(tmp_path: Path) -> None:
    given = {"title": "A run", "command": "crptpro", "summary": "", "tables": {}, "figures": {}}
    path = write_report(tmp_path / "report.md", **given)
    before = path.read_text()
    fill_disk_at(path)
    with pytest.raises(DiskSpaceError, match=r"report\.md cannot be written"):
        write_report(path, **{**given, "title": "Another"})
    assert path.read_text() == before

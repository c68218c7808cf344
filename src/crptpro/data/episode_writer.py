"""Whole episodes appended to raw files and sealed by a journal line: a kill loses at most the open one."""

from __future__ import annotations

import json
import logging
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from crptpro.data.episode import Episode
from crptpro.data.layout import CARD_FILE, JOURNAL_FILE, Layout
from crptpro.errors import DatasetError, DiskSpaceError, is_disk_full

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class JournalEntry:
    """One durable episode: its index, its rows, and the checksum of all bytes it added.

    ``wall_s`` is the time, in seconds, since the previous entry, or since this process began the dataset's first
    job.
    """

    episode: int
    transitions: int
    frames: int
    crc32: int
    is_cut: bool = False
    wall_s: float = 0.0

    def line(self) -> bytes:
        """Return the journal line."""
        return json.dumps(asdict(self)).encode() + b"\n"


def read_journal(path: Path) -> list[JournalEntry]:
    """Read the entries up to the first incomplete one (the line a kill interrupted)."""
    entries: list[JournalEntry] = []
    if not path.exists():
        return entries
    for line in path.read_bytes().split(b"\n")[:-1]:
        try:
            entry = JournalEntry(**json.loads(line))
        except (ValueError, TypeError):
            break
        if entry.episode != len(entries):
            break
        entries.append(entry)
    return entries


class EpisodeWriter:
    """Appends episodes 0, 1, 2, ... to a dataset directory.

    The bytes of an episode are written and synced before its journal line, so the journal never promises what
    is not there. Opening truncates every file to the last journaled episode whose bytes are intact, unless none
    is: then the layout is another one, or the files are not those of this journal, and nothing is touched.

    Args:
        root: The dataset's directory; created if missing.
        layout: Shapes of the rows.

    Raises:
        DatasetError: if the dataset is finished, its rows have other shapes, or the files cannot be opened.
    """

    def __init__(self, root: str | Path, layout: Layout):
        self.root = Path(root)
        self.layout = layout
        self._columns = layout.columns()
        self._files: dict[tuple[str, ...], int] = {}
        if (self.root / CARD_FILE).exists():
            raise DatasetError(
                f"{self.root} holds a finished dataset, which nothing may be appended to. Choose another directory."
            )
        self.entries = read_journal(self.root / JOURNAL_FILE)
        journaled = len(self.entries)
        try:
            self._drop_damaged()
            for column in self._columns:
                path = self.root / column.file
                path.parent.mkdir(parents=True, exist_ok=True)
                self._files[column.key] = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as reason:
            raise DatasetError(f"{self.root} cannot be written: {reason}.") from reason
        if len(self.entries) < journaled:
            logger.warning(
                "%s: %d of %d finished episodes are damaged and will be collected again.",
                self.root, journaled - len(self.entries), journaled,
            )  # fmt: skip
        self._journal = self._open_journal()
        self._truncate()

    @property
    def episodes(self) -> int:
        """Durable episodes."""
        return len(self.entries)

    @property
    def transitions(self) -> int:
        """Durable transitions."""
        return sum(entry.transitions for entry in self.entries)

    @property
    def frames(self) -> int:
        """Durable frames, one more per episode than transitions."""
        return sum(entry.frames for entry in self.entries)

    def append(self, episode: Episode, *, wall_s: float = 0.0) -> JournalEntry:
        """Append one episode; it is durable when this returns.

        Raises:
            DatasetError: if its rows do not have this dataset's shapes.
            DiskSpaceError: if the disk is full; everything journaled before is kept.
        """
        if episode.layout != self.layout or len(episode) < 1:
            raise DatasetError(
                f"{self.root} holds rows of {self.layout.to_dict()}, but episode {self.episodes} "
                f"brings {len(episode)} transitions of {episode.layout.to_dict()}. Collect it into another "
                "directory."
            )
        rows = episode.rows(episode=self.episodes, first_row=self.frames)
        checksum = 0
        with self._undone_on_failure():
            for column in self._columns:
                content = np.ascontiguousarray(
                    rows[column.key], dtype=np.dtype(column.dtype).newbyteorder("<")
                )
                content = content.reshape(-1).view(np.uint8)
                checksum = zlib.crc32(content.data, checksum)
                _write_all(self._files[column.key], content)
            for file in self._files.values():
                os.fsync(file)
            entry = JournalEntry(
                self.episodes, len(episode), len(episode) + 1, checksum, episode.is_cut, round(wall_s, 3)
            )
            _write_all(self._journal, np.frombuffer(entry.line(), np.uint8))
            os.fsync(self._journal)
        self.entries.append(entry)
        self._journal_bytes += len(entry.line())
        return entry

    def close(self) -> None:
        """Close the files; calling it twice is harmless."""
        for file in self._files.values():
            os.close(file)
        if self._files:
            os.close(self._journal)
        self._files = {}

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _undone_on_failure(self) -> Iterator[None]:
        try:
            yield
        except OSError as reason:
            self._truncate()
            if is_disk_full(reason):
                raise DiskSpaceError(
                    f"The disk under {self.root} is full after {self.transitions} transitions "
                    f"({self.episodes} whole episodes), which are kept. Free space and run the same command "
                    "again."
                ) from reason
            raise DatasetError(f"{self.root} cannot be written: {reason}.") from reason
        except BaseException:
            self._truncate()
            raise

    def _truncate(self) -> None:
        rows = {"frames": self.frames, "transitions": self.transitions}
        for column in self._columns:
            file = self._files[column.key]
            os.ftruncate(file, rows[column.part] * column.row_bytes)
            os.lseek(file, 0, os.SEEK_END)
        os.ftruncate(self._journal, self._journal_bytes)
        os.lseek(self._journal, 0, os.SEEK_END)

    def _open_journal(self) -> int:
        """Open the journal for appending, rewritten first if it holds more than the intact entries."""
        path = self.root / JOURNAL_FILE
        kept = b"".join(entry.line() for entry in self.entries)
        if not path.exists() or path.read_bytes() != kept:
            temporary = path.with_name(f".{path.name}.new")
            with open(temporary, "wb") as file:
                file.write(kept)
                file.flush()
                os.fsync(file.fileno())  # otherwise a power cut may leave an empty journal under the new name
            os.replace(temporary, path)
        self._journal_bytes = len(kept)
        return os.open(path, os.O_RDWR)

    def _drop_damaged(self) -> None:
        """Forget the last episodes up to the first intact one, and refuse a directory in which none is."""
        kept = len(self.entries)
        if kept and not self._is_intact(kept - 1) and not self._is_intact(0):
            raise DatasetError(
                f"{self.root} does not hold the rows of {self.layout.to_dict()} that its {JOURNAL_FILE} vouches for: "
                "they have other shapes, or the files are damaged from the first episode on. Open it with the "
                "layout it was begun with, or remove the directory to collect anew."
            )
        while kept and not self._is_intact(kept - 1):
            kept -= 1
        del self.entries[kept:]

    def _is_intact(self, index: int) -> bool:
        """Compare what an episode added to the files with its checksum; opens them for reading alone."""
        entry, before = self.entries[index], self.entries[:index]
        rows = {
            "frames": (sum(other.frames for other in before), entry.frames),
            "transitions": (sum(other.transitions for other in before), entry.transitions),
        }
        checksum = 0
        for column in self._columns:
            first, count = rows[column.part]
            try:
                with open(self.root / column.file, "rb") as file:
                    file.seek(first * column.row_bytes)
                    content = file.read(count * column.row_bytes)
            except FileNotFoundError:
                return False
            checksum = zlib.crc32(content, checksum)
        return checksum == entry.crc32


def _write_all(file: int, content: np.ndarray) -> None:
    while len(content):
        content = content[os.write(file, content.data) :]

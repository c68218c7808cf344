"""Checkpoints that survive a kill at any moment: written aside, verified, renamed, rotated.

``torchrl.checkpoint`` (0.14) renames what it wrote, but it neither syncs it to disk nor records a checksum,
its rotation prunes without reading the new checkpoint back, and its ``load_latest`` raises on a damaged
newest checkpoint instead of falling back to the one before. Runs here promise all four, hence this class.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import numbers
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, cast

import torch

from crptpro.errors import CheckpointError, DiskSpaceError, is_disk_full

CHECKPOINTS = "checkpoints"
"""Where a run keeps them, below its directory."""

_LOG = logging.getLogger(__name__)
_NAME = re.compile(r"checkpoint-(\d{12})-([0-9a-f]{64})\.pt")
_PARTIAL = ".partial-checkpoint-"
_CHUNK_BYTES = 1 << 22


class CheckpointDir:
    """A directory of checkpoints of one run, newest last.

    Each checkpoint is one file whose name carries its counter and the SHA-256 of its content, so that the
    single rename that publishes it also publishes its checksum. Files are read back and compared before
    anything older is removed. Only plain values are stored and they are loaded with ``weights_only=True``:
    opening a checkpoint never runs code.

    Args:
        path: the directory; created by the first :meth:`save`.
        keep_last: number of verified checkpoints to keep, at least 1. With 2, damage to the newest costs
            only the updates since the one before.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     checkpoints = CheckpointDir(folder)
        ...     _ = checkpoints.save({"weight": torch.ones(2)}, counter=10)
        ...     checkpoints.latest_counter(), checkpoints.load_latest()["weight"].tolist()
        (10, [1.0, 1.0])
    """

    def __init__(self, path: str | Path, keep_last: int = 2) -> None:
        if keep_last < 1:
            raise ValueError(f"keep_last must be at least 1, got {keep_last}.")
        self.path = Path(path)
        self.keep_last = keep_last

    def save(self, state: Mapping[str, Any], *, counter: int) -> Path:
        """Write ``state`` under ``counter`` and, once it is verified on disk, remove what is no longer kept.

        Args:
            state: nested dicts, lists and tuples of tensors, numbers, strings and ``None``.
            counter: progress that orders the checkpoints, e.g. updates; not negative. Checkpoints with a
                higher counter belong to a future that was abandoned (they were damaged) and are removed.

        Returns:
            The file written.

        Raises:
            CheckpointError: if a value is not plain (named by its place), or the file does not read back.
            DiskSpaceError: if the disk or quota is full. Earlier checkpoints are untouched.
        """
        plain = _plain(state, "state")
        partial = self.path / f"{_PARTIAL}{os.getpid()}"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for leftover in self.path.glob(f"{_PARTIAL}*"):
                leftover.unlink(missing_ok=True)
            digest = self._write(plain, partial)
            if _sha256(partial) != digest:
                raise CheckpointError(f"{partial} does not read back as it was written; check the disk.")
            _load(partial)
            final = self.path / f"checkpoint-{counter:012d}-{digest}.pt"
            os.replace(partial, final)
            sync_directory(self.path)
        except OSError as reason:
            raise self._write_error(reason) from reason
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
        self._rotate(final, counter)
        return final

    def load_latest(self) -> dict[str, Any] | None:
        """Return the newest checkpoint that verifies, tensors on the CPU; ``None`` if there is none at all.

        Raises:
            CheckpointError: if there are checkpoints and all are damaged.
        """
        entries = self._entries()
        for counter, digest, path in reversed(entries):
            try:
                if _sha256(path) != digest:
                    raise CheckpointError("its checksum does not match its name")
                return _load(path)
            except (OSError, CheckpointError) as reason:
                _LOG.warning(
                    "Checkpoint %s (counter %d) is damaged (%s); using the one before.", path, counter, reason
                )
        if entries:
            raise CheckpointError(
                f"All {len(entries)} checkpoints in {self.path} are damaged. "
                "Remove that directory to start again."
            )
        return None

    def latest_counter(self) -> int | None:
        """Return the counter of the newest checkpoint by name (not verified), or ``None``."""
        entries = self._entries()
        return entries[-1][0] if entries else None

    def _entries(self) -> list[tuple[int, str, Path]]:
        """(counter, sha256, path), oldest first; the file time orders two files of one counter."""
        found = []
        for path in self.path.glob("checkpoint-*.pt") if self.path.is_dir() else ():
            if match := _NAME.fullmatch(path.name):
                found.append((int(match[1]), path.stat().st_mtime_ns, match[2], path))
        return [(counter, digest, path) for counter, _, digest, path in sorted(found)]

    def _rotate(self, newest: Path, counter: int) -> None:
        older = [entry for entry in self._entries() if entry[0] < counter]
        keep = {path for _, _, path in older[len(older) - self.keep_last + 1 :]} | {newest}
        for _, _, path in self._entries():
            if path not in keep:
                path.unlink(missing_ok=True)

    @staticmethod
    def _write(state: dict[str, Any], path: Path) -> str:
        with open(path, "wb") as file:
            writer = _HashingWriter(file)
            torch.save(state, cast(IO[bytes], writer))  # it needs nothing but write and flush
            if writer.error is not None:
                raise writer.error
            file.flush()
            os.fsync(file.fileno())
        return writer.sha256.hexdigest()

    def _write_error(self, reason: OSError) -> CheckpointError | DiskSpaceError:
        if is_disk_full(reason):
            return DiskSpaceError(
                f"The disk is full: no checkpoint could be written to {self.path}. Earlier ones are kept; "
                "free space and start the same command again."
            )
        return CheckpointError(
            f"No checkpoint could be written to {self.path}: {reason}. Earlier ones are kept."
        )


class _HashingWriter:
    """Hash what ``torch.save`` writes, and keep its first error until the archive is closed.

    Raising inside ``write`` would reach torch's native archive writer, whose clean-up then hides the cause.
    """

    def __init__(self, file: Any) -> None:
        self.file = file
        self.sha256 = hashlib.sha256()
        self.error: OSError | None = None

    def write(self, content: Any) -> int:
        if self.error is None:
            try:
                self.file.write(content)
                self.sha256.update(content)
            except OSError as reason:
                self.error = reason
        return len(content)

    def flush(self) -> None:
        pass


def sync_directory(path: Path) -> None:
    """Make a rename inside ``path`` durable."""
    with contextlib.suppress(OSError):  # some network file systems cannot sync a directory
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def _load(path: Path) -> dict[str, Any]:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as reason:  # torch raises many types for a foreign file
        raise CheckpointError(f"it cannot be loaded: {reason}") from reason


def _plain(value: Any, where: str) -> Any:
    """Copy a state into builtin containers and plain CPU-loadable tensors, or name what is not plain."""
    if isinstance(value, torch.Tensor):
        tensor = value.detach().as_subclass(torch.Tensor)
        # torch.save writes the whole storage behind a view; a slice of a big buffer would drag the buffer
        # along.
        is_view = tensor.untyped_storage().nbytes() > tensor.numel() * tensor.element_size()
        return tensor.clone() if is_view else tensor
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value)
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, (str, int)):
                raise CheckpointError(
                    f"{where} has the key {key!r} ({type(key).__name__}); keys are str or int."
                )
        return {key: _plain(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        items = [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
        return items if isinstance(value, list) else tuple(items)
    raise CheckpointError(
        f"{where} is a {type(value).__name__}; it may hold tensors, numbers, strings, lists, dicts."
    )

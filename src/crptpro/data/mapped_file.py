"""A file whose bytes are reserved, as memory: the rows of a replay on disk."""

from __future__ import annotations

import errno
import mmap
import os
from pathlib import Path

from crptpro.errors import CheckpointError, DiskSpaceError, is_disk_full, writing_error


def map_file(path: Path, size: int) -> mmap.mmap:
    """Map a file, making it or keeping what is in it.

    Args:
        path: of the file, in an existing directory.
        size: bytes.

    Raises:
        CheckpointError: there is a file of another size.
        DiskSpaceError: the disk cannot hold it; nothing is left of what was reserved.
        OSError: naming the file, for any other reason.
    """
    found = path.stat().st_size if path.exists() else 0
    if found not in (0, size):
        raise CheckpointError(
            f"{path} has {found:,} bytes, this replay needs {size:,}: it belongs to a replay of another size. Use "
            "the capacity and slack it was written with, or another directory."
        )
    # A new one has its name once it is whole: a kill while it is reserved leaves nothing that looks like rows.
    partial = path.with_name(f".{path.name}.partial")
    # Not by open(path, "a+b"): a file system that cannot reserve has glibc write instead, which it refuses to do in a
    # file that is appended to.
    handle = os.open(path if found else partial, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        os.ftruncate(handle, found)  # drops what such a kill left, of whatever size
        try:
            # Reserved, not sparse: a disk that fills up later would end the process by a bus error.
            os.posix_fallocate(handle, 0, size)
        except OSError as reason:
            os.ftruncate(handle, found)  # what was reserved before the disk was full
            if is_disk_full(reason) or reason.errno == errno.EFBIG:
                raise DiskSpaceError(
                    f"{path} needs {size / 1e9:.2f} GB: {reason}. Free space, or choose another directory or a smaller "
                    "capacity."
                ) from reason
            raise writing_error(path, reason) from reason
        if not found:
            os.replace(partial, path)
        return mmap.mmap(handle, size)
    finally:
        os.close(handle)
        partial.unlink(missing_ok=True)

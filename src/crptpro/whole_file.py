"""Small files that are written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from crptpro.errors import writing_error


def write_whole(path: str | Path, content: str | bytes) -> Path:
    """Write a file beside ``path`` and rename it into place: a reader, or a power cut, never meets half of it.

    Args:
        path: of the file; its directory is made.
        content: text becomes UTF-8, its line ends as they are.

    Returns:
        ``path``.

    Raises:
        DiskSpaceError: if the disk is full; what was there before is kept.
        OSError: if it cannot be written for another reason; it names the path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as reason:
        raise writing_error(path, reason) from reason
    finally:
        partial.unlink(missing_ok=True)
    return path

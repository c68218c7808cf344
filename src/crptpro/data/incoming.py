"""Finished episodes that wait on disk for an earlier one."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from crptpro.data.episode import Episode

INCOMING = ".incoming"
_ARRAYS = ("pixels", "action", "reward", "terminated", "truncated")


def dataset_path(root: str | Path, domain_name: str) -> Path:
    """Return the directory of a domain's dataset: its name, ``-`` for what a file system may refuse."""
    return Path(root) / re.sub(r"[^\w.+-]+", "-", domain_name)


def write_incoming(root: Path, index: int, episode: Episode) -> None:
    """Keep an episode that came before its turn; it survives a kill once this returns."""
    path = _file(root, index)
    path.parent.mkdir(exist_ok=True)
    arrays = {name: getattr(episode, name) for name in _ARRAYS}
    arrays |= {f"state_{name}": values for name, values in episode.state.items()}
    temporary = path.with_suffix(".new")
    try:
        with open(temporary, "wb") as file:
            np.savez(file, is_cut=np.array(episode.is_cut), **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_incoming(root: Path) -> Iterator[tuple[int, Episode]]:
    """Yield index and episode of everything kept; what cannot be read is left out, and so collected again."""
    for path in sorted((root / INCOMING).glob("*.npz")):
        try:
            with np.load(path) as arrays:  # compares the archive's checksums
                content = dict(arrays)
            state = {name: content.pop(name) for name in list(content) if name.startswith("state_")}
            episode = Episode(
                is_cut=bool(content.pop("is_cut")),
                state={name.removeprefix("state_"): values for name, values in state.items()},
                **content,
            )
        except Exception:
            continue
        yield int(path.stem), episode


def drop_incoming(root: Path, index: int) -> None:
    """Forget one kept episode, if there is one."""
    _file(root, index).unlink(missing_ok=True)


def drop_all_incoming(root: Path) -> None:
    """Forget every kept episode."""
    shutil.rmtree(root / INCOMING, ignore_errors=True)


def _file(root: Path, index: int) -> Path:
    return root / INCOMING / f"{index:06d}.npz"

"""A directory of weights and a card, written whole or not at all and checked before use."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil
from torch import Tensor, nn

from crptpro.cards import read_json, write_json
from crptpro.errors import CRPTproError, DiskSpaceError, writing_error

WEIGHTS_FILE = "weights.safetensors"
CARD_FILE = "card.json"
TRIMMED_FROM = "trimmed_from"


def write_artifact(
    path: str | Path,
    modules: Mapping[str, nn.Module | Mapping[str, Tensor]],
    *,
    card: Mapping[str, Any],
    format_name: str,
    version: int,
) -> Path:
    """Write ``weights.safetensors`` and ``card.json`` beside ``path`` and rename the directory into place.

    A reader sees the old artifact or the new one, never a mixture; a write that fails (a full disk, a kill)
    leaves the old one. What a killed process left beside it is removed.

    Args:
        path: directory to write or replace.
        modules: name to network or to its state dict; tensors are stored as ``name.key``.
        card: JSON-able facts; ``format``, ``version`` and ``weights_sha256`` are added.
        format_name: what kind of artifact this is.
        version: of the format.

    Returns:
        ``path``.

    Raises:
        CRPTproError: if there is something else at ``path``, or it leads to the current directory from there; it is
            left alone.
        DiskSpaceError: if the disk is full; an artifact there is kept.
    """
    given, path = Path(path), _with_name(Path(path))
    _refuse_foreign(path, format_name)
    _refuse_under_foot(given)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(path)
    tensors = {}
    for name, module in modules.items():
        state = module.state_dict() if isinstance(module, nn.Module) else module
        # A clone: safetensors refuses tensors that share storage, as slices of one buffer do.
        tensors.update(
            {f"{name}.{key}": value.detach().cpu().contiguous().clone() for key, value in state.items()}
        )
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f"{_temporary_prefix(path)}{os.getpid()}-"))
    try:
        weights = temporary / WEIGHTS_FILE
        _save_tensors(tensors, weights)
        weights.chmod(0o644)  # safetensors makes files that only their owner can read
        with open(weights, "rb") as file:
            os.fsync(file.fileno())
        digest = _sha256(weights)
        facts = {"format": format_name, "version": version, "weights_sha256": digest}
        write_json(temporary / CARD_FILE, {**card, **facts})
        temporary.chmod(0o755)
        _replace_directory(temporary, path)
    except BaseException as reason:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(reason, (OSError, DiskSpaceError)):
            raise writing_error(path, reason) from reason
        raise
    return given


def read_artifact(
    path: str | Path, *, format_name: str, version: int, error: type[CRPTproError] = CRPTproError
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read and verify an artifact.

    Returns:
        The card, and the tensors by ``name.key`` on the CPU.

    Raises:
        CRPTproError: (or ``error``) naming what is missing, damaged, of another kind or too new.
    """
    path = _with_name(Path(path))
    while True:
        source = _current(path)
        before = _identity(source)
        try:
            found = _read(source, format_name, version, error)
        except (error, OSError):
            if _identity(_current(path)) == before:
                raise
            continue  # a writer has replaced it meanwhile: the new one counts
        if _identity(source) == before:
            return found


def identity_of(card: Mapping[str, Any]) -> str | None:
    """Return what tells an artifact's weights from any others, as its card says it: the method and a checksum.

    A trimmed artifact is named as the one it comes from, because it serves as that does. ``None`` if the card names no
    weights.
    """
    if TRIMMED_FROM in card:
        return str(card[TRIMMED_FROM])
    if "weights_sha256" in card:
        return f"{card.get('method', 'unknown')}:{card['weights_sha256']}"
    return None


def _save_tensors(tensors: dict[str, Tensor], path: Path) -> None:
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    try:
        save_file(tensors, path)
    except SafetensorError as reason:
        # It says what the system did in words alone: "I/O error: No space left on device (os error 28)".
        if number := re.search(r"(?:os error|code:) (\d+)", str(reason)):
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from reason
        raise


def _read(
    path: Path, format_name: str, version: int, error: type[CRPTproError]
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_dir():
        raise error(
            f"{path} does not exist or is not a directory; expected one with {WEIGHTS_FILE} and {CARD_FILE}."
        )
    card = read_json(path / CARD_FILE, error=error)
    if card.get("format") != format_name:
        raise error(
            f"{path} is a {card.get('format', 'directory of unknown format')!r}, expected {format_name!r}."
        )
    if card.get("version", 0) > version:
        raise error(
            f"{path} has format version {card['version']}; this crptpro reads up to {version}. Upgrade crptpro."
        )
    weights = path / WEIGHTS_FILE
    if not weights.exists():
        raise error(f"{weights} is missing; the artifact is incomplete. Copy the whole directory.")
    if _sha256(weights) != card.get("weights_sha256"):
        raise error(f"{weights} is not the file its card was written for: truncated, damaged or replaced.")
    try:
        return card, load_file(weights)
    except (SafetensorError, OSError) as reason:
        raise error(f"{weights} cannot be read ({reason}).") from None


def _refuse_foreign(path: Path, format_name: str) -> None:
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not (path / CARD_FILE).exists() or read_json(path / CARD_FILE).get("format") != format_name:
        raise CRPTproError(
            f"{path} exists and is no {format_name!r}; it is not replaced. Choose another directory."
        )


def _refuse_under_foot(path: Path) -> None:
    """A path from a directory that was renamed and removed leads nowhere; an absolute one leads to the new one."""
    if not path.is_absolute() and path.exists() and Path.cwd().is_relative_to(path.resolve()):
        raise CRPTproError(
            f"{path} is the current directory or around it, which writing would replace as a whole. Go to another "
            "one first, or name another directory."
        )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def _with_name(path: Path) -> Path:
    """Return a path that ends in the directory's name, which ``.`` and ``..`` do not: its neighbours are named so."""
    return path.resolve() if path.name in ("", "..") else path


def _previous(path: Path) -> Path:
    return path.parent / f".{path.name}.previous"  # the root has no name at all


def _replace_directory(new: Path, path: Path) -> None:
    """Swap directories; a reader that comes between the two renames, or after a kill there, uses the old one."""
    previous = _previous(path)
    if path.exists():
        shutil.rmtree(previous, ignore_errors=True)
        os.rename(path, previous)
    os.rename(new, path)
    shutil.rmtree(previous, ignore_errors=True)


def _current(path: Path) -> Path:
    """Return where the artifact is. It is left there: a writer may be at work."""
    previous = _previous(path)
    return previous if previous.is_dir() and not path.exists() else path


def _identity(path: Path) -> tuple[int, int, int] | None:
    """Return what tells this directory from one that takes its place."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns


def _temporary_prefix(path: Path) -> str:
    """Return how this machine's temporary directories for ``path`` begin; the writer's pid follows."""
    return f".{path.name}.writing-{socket.gethostname()}-"


def _remove_stale(path: Path) -> None:
    """Remove what writers on this machine left that are dead; others may be alive and are left alone."""
    prefix = _temporary_prefix(path)
    for item in path.parent.iterdir():
        if not item.name.startswith(prefix):
            continue
        pid = item.name[len(prefix) :].partition("-")[0]
        if pid.isdecimal() and not psutil.pid_exists(int(pid)):
            shutil.rmtree(item, ignore_errors=True)

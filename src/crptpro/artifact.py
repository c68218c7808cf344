"""Files and directories that are written whole or not at all, and are verified before use."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from crptpro.errors import CRPTproError, DiskSpaceError, writing_error
from crptpro.values import as_path, as_plain

WEIGHTS_FILE = "weights.safetensors"
CARD_FILE = "card.json"


def write_whole(path: str | Path, content: str | bytes) -> Path:
    """Write a file (text as UTF-8) beside ``path`` and rename it into place: no reader sees a partial file.

    Returns ``path``. A full disk raises a DiskSpaceError, another failure an OSError with the path; the old file stays.
    """
    path = as_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.partial")
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


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object as :func:`write_whole` does; a ValueError names an entry that JSON cannot hold."""
    plain = as_plain(content, Path(path).name)
    write_whole(path, json.dumps(plain, indent=2, sort_keys=True) + "\n")


def read_json(
    path: str | Path, *, keys: Iterable[str] = (), error: type[CRPTproError] = CRPTproError
) -> dict[str, Any]:
    """Read a JSON object with these keys; raises ``error`` if the file is missing, not JSON, or not such an object."""
    path = as_path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise error(f"{path} does not exist.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as reason:
        raise error(f"{path} cannot be read as JSON ({reason}); it is damaged or not written by crptpro.") from None
    if not isinstance(content, dict):
        raise error(f"{path} holds a {type(content).__name__}, expected a JSON object.")
    if missing := [key for key in keys if key not in content]:
        raise error(f"{path} has no {', '.join(missing)}; it is damaged or not written by crptpro.")
    return content


def require_disk(
    path: str | Path,
    needed_bytes: int,
    what: str,
    remedy: str = "Free space, choose another directory, or request less.",
) -> None:
    """Raise a DiskSpaceError if the disk under ``path`` cannot hold ``needed_bytes`` with 5 % to spare."""
    probe = as_path(path).absolute()
    while not probe.exists():
        probe = probe.parent
    free = shutil.disk_usage(probe).free
    if needed_bytes * 1.05 > free:
        raise DiskSpaceError(
            f"{what} needs {needed_bytes / 1e9:.2f} GB, but {probe} has {free / 1e9:.2f} GB free. {remedy}"
        )


def require_replaceable(path: str | Path, format_name: str) -> Path:
    """Raise a CRPTproError if an artifact may not be written to ``path``; see :func:`write_artifact`."""
    given = as_path(path)
    path = given.resolve()
    if path.exists() and path.samefile("."):
        raise CRPTproError(f"{path} is the working directory, which is not replaced. Write to {path / 'encoder'}.")
    is_free = not path.exists() or (path.is_dir() and not any(path.iterdir()))
    if not is_free and (not (path / CARD_FILE).exists() or read_json(path / CARD_FILE).get("format") != format_name):
        raise CRPTproError(
            f"{path} exists and is not a {format_name!r}, so it was left unchanged. Choose another directory, such "
            f"as {path / 'encoder'}."
        )
    names = sorted(each.name for each in path.glob("[!.]*")) if not is_free else []
    if other := [name for name in names if name not in (CARD_FILE, WEIGHTS_FILE)]:
        raise CRPTproError(
            f"{path} holds {', '.join(other)} beside the {format_name!r} that would be replaced, so it was left "
            f"unchanged. Move that, or choose another directory, such as {path / 'encoder'}."
        )
    return given


def write_artifact(
    path: str | Path,
    modules: Mapping[str, nn.Module | Mapping[str, Tensor]],
    *,
    card: Mapping[str, Any],
    format_name: str,
    version: int,
    check: Callable[[dict[str, Any], dict[str, Tensor]], object] | None = None,
) -> Path:
    """Write ``weights.safetensors`` and ``card.json`` beside ``path`` and rename the directory into place.

    The new files are read back, and ``check`` is called with card and tensors, before they replace anything. A reader
    never sees a mixture, and a write that fails, e.g. on a full disk, leaves the old artifact. (A kill between the two
    renames leaves it as ``.NAME.previous`` until the next write.)

    ``modules`` maps names to networks or their state dicts; tensors are stored as ``name.key``. ``format``, ``version``
    and ``weights_sha256`` are added to the entries of ``card``. Returns ``path``.

    Raises:
        CRPTproError: ``path`` is the working directory, is not an artifact of this format, or holds other files too; it
            is left unchanged.
        ValueError: an entry of ``card`` cannot be stored as JSON.
        DiskSpaceError: the disk is full; an artifact there is kept.
    """
    from safetensors.torch import save

    given = require_replaceable(path, format_name)
    path = given.resolve()
    tensors = {}
    for name, module in modules.items():
        state = module.state_dict() if isinstance(module, nn.Module) else module
        # A clone: safetensors refuses tensors that share storage, as slices of one buffer do.
        tensors.update({f"{name}.{k}": v.detach().cpu().contiguous().clone() for k, v in state.items()})
    content = save(tensors)
    facts = {"format": format_name, "version": version, "weights_sha256": hashlib.sha256(content).hexdigest()}
    temporary = path.with_name(f".{path.name}.writing.{os.getpid()}")
    previous = path.with_name(f".{path.name}.previous")
    try:
        write_whole(temporary / WEIGHTS_FILE, content)
        write_json(temporary / CARD_FILE, {**card, **facts})
        found = read_artifact(temporary, format_name=format_name, version=version)
        if check is not None:
            check(*found)
        if path.exists():
            shutil.rmtree(previous, ignore_errors=True)
            os.rename(path, previous)
        try:
            os.rename(temporary, path)
        except OSError:
            if previous.exists():
                os.rename(previous, path)
            raise
        shutil.rmtree(previous, ignore_errors=True)
    except (OSError, DiskSpaceError) as reason:
        raise writing_error(path, reason) from reason
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return given


def read_artifact(
    path: str | Path, *, format_name: str, version: int, error: type[CRPTproError] = CRPTproError
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the card of an artifact, and its tensors by ``name.key`` on the CPU.

    Raises ``error``, naming what is missing, damaged, of another kind or too new.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = as_path(path).resolve()
    if not path.is_dir():
        raise error(f"{path} does not exist or is not a directory; expected one with {WEIGHTS_FILE} and {CARD_FILE}.")
    if not (path / CARD_FILE).exists():
        hint = ""
        for inside in sorted(path.glob(f"[!.]*/{CARD_FILE}")):
            with contextlib.suppress(CRPTproError):  # it is damaged
                if read_json(inside).get("format") == format_name:
                    hint = f" Did you mean {inside.parent}?"
                    break
        raise error(f"{path} has no {CARD_FILE}: it is not an artifact.{hint}")
    card = read_json(path / CARD_FILE, error=error)
    if card.get("format") != format_name:
        raise error(f"{path} is a {card.get('format', 'directory of unknown format')!r}, expected {format_name!r}.")
    if (found := card.get("version")) != version:
        raise error(f"{path} has format version {found}; this release reads {version}. Create it again, or upgrade.")
    weights = path / WEIGHTS_FILE
    try:
        content = weights.read_bytes()
    except FileNotFoundError:
        raise error(f"{weights} is missing; the artifact is incomplete. Copy the whole directory.") from None
    if hashlib.sha256(content).hexdigest() != card.get("weights_sha256"):
        raise error(f"{weights} is not the file its card was written for: truncated, damaged or replaced.")
    try:
        return card, load(content)
    except (SafetensorError, ValueError) as reason:
        raise error(f"{weights} cannot be read ({reason}).") from None


def identity_of(card: Mapping[str, Any]) -> str | None:
    """Return what identifies an artifact's weights: the method and a checksum; ``None`` without weights.

    A slim copy has the identity of the artifact that it was made from.
    """
    if "weights_sha256" not in card:
        return None
    return card.get("slim_of") or f"{card.get('method', 'unknown')}:{card['weights_sha256']}"

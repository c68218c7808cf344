"""Modules of the user, imported before a command runs, so that their domains and methods are known."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from crptpro.errors import CRPTproError

FLAG = "--plugin"

_loaded: list[str] = []


def load_plugin(name: str) -> None:
    """Import a module, or a Python file.

    Args:
        name: of an installed module or one in the working directory, or a path that ends in ``.py``.

    Raises:
        CRPTproError: it does not exist, cannot be imported, or the file has another module's name.
    """
    path = Path(name)
    is_file = path.suffix == ".py"
    if is_file and not path.is_file():
        raise CRPTproError(f"{FLAG} {name}: there is no such file.")
    folder = str(path.resolve().parent if is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that it hides no installed module
    module_name = path.stem if is_file else name
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as reason:
        if reason.name is None or reason.name != module_name.split(".")[0]:
            raise CRPTproError(f"{FLAG} {name}: it cannot be imported ({reason}).") from reason
        raise CRPTproError(
            f"{FLAG} {name}: there is no such module; name an installed one, one of this directory, or a .py file."
        ) from None
    if is_file and Path(getattr(module, "__file__", None) or "").resolve() != path.resolve():
        raise CRPTproError(f"{FLAG} {name}: {module_name!r} is the name of another module; rename the file.")
    full_name = str(path.resolve()) if is_file else name
    if full_name not in _loaded:
        _loaded.append(full_name)


def load_plugins(arguments: Sequence[str]) -> list[str]:
    """Import every module that ``--plugin`` names, anywhere on a command line, and return the other arguments.

    Raises:
        CRPTproError: no name follows, or as :func:`load_plugin`.
    """
    rest: list[str] = []
    words = iter(arguments)
    for word in words:
        flag, equals, value = word.partition("=")
        if flag != FLAG:
            rest.append(word)
            continue
        name = value if equals else next(words, "")
        if not name or name.startswith("-"):
            raise CRPTproError(f"{FLAG} needs a module or a Python file, e.g. {FLAG} my_method.py.")
        load_plugin(name)
    return rest


def load_again(names: Iterable[str]) -> None:
    """Load the plugins (:func:`loaded_plugins`) of the parent process in its worker."""
    for name in names:
        load_plugin(name)


def loaded_plugins() -> tuple[str, ...]:
    """Return the plugins of this process, files by their absolute paths."""
    return tuple(_loaded)

"""Modules of the user, imported before a command runs, so that their domains and methods are registered."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from crptpro.errors import CRPTproError
from crptpro.values import as_path

FLAG = "--plugin"

_loaded: list[str] = []


def load_plugin(name: str) -> None:
    """Import a module, installed or in the working directory, or a Python file, a path that ends in ``.py``.

    A missing module or dependency, or a file with the name of another module, raises a ``CRPTproError``.
    """
    path = as_path(name, FLAG)
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
        remedy = "A plugin is a .py file or a module, installed or of this directory, and imports what is installed."
        raise CRPTproError(f"{FLAG} {name}: it cannot be imported ({reason}). {remedy}") from reason
    if is_file and Path(getattr(module, "__file__", None) or "").resolve() != path.resolve():
        raise CRPTproError(f"{FLAG} {name}: {module_name!r} is the name of another module; rename the file.")
    full_name = str(path.resolve()) if is_file else name
    if full_name not in _loaded:
        _loaded.append(full_name)


def load_plugins(arguments: Sequence[str]) -> list[str]:
    """Import every module that ``--plugin`` names, anywhere on a command line, and return the other arguments."""
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


def loaded_plugins() -> tuple[str, ...]:
    """Return the plugins of this process, files by their absolute paths."""
    return tuple(_loaded)

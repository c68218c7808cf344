"""``--plugin``: modules of the user's own, run before a command, so that what they register has names on it."""

from __future__ import annotations

from collections.abc import Sequence

from crptpro.errors import CRPTproError
from crptpro.plugins import FLAG, load_plugin


def load_plugins(arguments: Sequence[str]) -> list[str]:
    """Import every module that ``--plugin`` names, anywhere on a command line.

    Args:
        arguments: of the command.

    Returns:
        The other arguments.

    Raises:
        CRPTproError: nothing is named, or there is no such module.
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

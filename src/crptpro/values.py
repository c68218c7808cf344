"""Numbers and paths from users: taken as the plain value they mean, or refused before any work starts."""

from __future__ import annotations

import math
import operator
import os
from pathlib import Path
from typing import Any


def as_int(value: Any, name: str, *, minimum: int | None = None, maximum: int | None = None) -> int:
    """Return a count, size or seed as a plain ``int``.

    NumPy and torch scalars and floats of integer value (``1e5``) are taken as the number they mean, so that cards,
    checkpoints and file names hold nothing else.

    Args:
        value: the number.
        name: of the setting, for the message.
        minimum: smallest allowed value.
        maximum: largest allowed value.

    Raises:
        ValueError: naming the setting, its value and what is allowed.

    Examples:
        >>> as_int(1e5, "transitions", minimum=1)
        100000
    """
    number: Any = value
    if hasattr(number, "item") and getattr(number, "ndim", 0) == 0:
        number = number.item()
    if isinstance(number, float) and number.is_integer():
        number = int(number)
    try:
        if isinstance(number, bool):
            raise TypeError
        number = operator.index(number)
    except TypeError:
        raise ValueError(f"`{name}` must be a whole number, got {value!r}.") from None
    _require_range(number, value, name, minimum, maximum)
    return number


def as_float(value: Any, name: str, *, minimum: float | None = None, maximum: float | None = None) -> float:
    """Return a coefficient or rate as a plain finite ``float``.

    Args:
        value: the number.
        name: of the setting, for the message.
        minimum: smallest allowed value.
        maximum: largest allowed value.

    Raises:
        ValueError: naming the setting, its value and what is allowed.

    Examples:
        >>> as_float(1, "tau", minimum=0, maximum=1)
        1.0
    """
    try:
        if isinstance(value, (bool, str, bytes)):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"`{name}` must be a number, got {value!r}.") from None
    if not math.isfinite(number):
        raise ValueError(f"`{name}` must be finite, got {value!r}.")
    _require_range(number, value, name, minimum, maximum)
    return number


def as_path(value: str | os.PathLike[str], name: str = "path") -> Path:
    """Return a path with ``~`` expanded.

    Args:
        value: as the user wrote it.
        name: of the setting, for the message.

    Raises:
        ValueError: for an empty path, or one whose bytes are not UTF-8 and could not be written into a record.

    Examples:
        >>> as_path("~/runs") == Path.home() / "runs"
        True
    """
    text = os.fspath(value)
    if not text:
        raise ValueError(f"`{name}` is empty; name a directory, or `.` for the working directory.")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"`{name}` is not UTF-8: {os.fsencode(text)!r}; choose another name.") from None
    return Path(text).expanduser()


def _require_range(
    number: float, value: Any, name: str, minimum: float | None, maximum: float | None
) -> None:
    if minimum is not None and number < minimum:
        raise ValueError(f"`{name}` must be at least {minimum}, got {value!r}.")
    if maximum is not None and number > maximum:
        raise ValueError(f"`{name}` must be at most {maximum}, got {value!r}.")

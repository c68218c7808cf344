"""Validation of user input before any work starts, and access to the entries of batches."""

from __future__ import annotations

import dataclasses
import math
import operator
import os
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from crptpro.errors import CRPTproError

Quality = Literal["exact", "fast"]
Colors = Literal["normal", "reversed_background", "reversed_image"]
"""Both are explained by :func:`crptpro.envs.make_env`."""

MAX_SEED = 2**32 - 1
"""NumPy's largest."""


def check_choices(**given: str) -> None:
    """Refuse a ``quality`` or ``colors`` that does not exist, with a ``CRPTproError``."""
    for name, value in given.items():
        if value not in (allowed := get_args({"quality": Quality, "colors": Colors}[name])):
            raise CRPTproError(f"{name} must be {' or '.join(map(repr, allowed))}, got {value!r}.")


def as_int(value: Any, name: str, *, minimum: int | None = None, maximum: int | None = None) -> int:
    """Return a count, size or seed as a plain ``int``: of an int, a NumPy or torch scalar, or a float such as ``1e5``.

    Anything else raises a ``ValueError``, which names the setting, its value and what is allowed.
    """
    try:
        number = _scalar(value)
        if isinstance(number, (float, np.floating)) and number.is_integer():
            number = int(number)
        number = operator.index(number)
    except TypeError:
        raise ValueError(f"`{name}` must be a whole number, got {value!r}.") from None
    _require_range(number, value, name, minimum, maximum)
    return number


def as_float(value: Any, name: str, *, minimum: float | None = None, maximum: float | None = None) -> float:
    """Return a coefficient or rate as a plain finite ``float``; a ValueError as in :func:`as_int`."""
    try:
        number = float(_scalar(value))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"`{name}` must be a number, got {value!r}.") from None
    if not math.isfinite(number):
        raise ValueError(f"`{name}` must be finite, got {value!r}.")
    _require_range(number, value, name, minimum, maximum)
    return number


def as_path(value: str | os.PathLike[str], name: str = "path") -> Path:
    """Return a path with ``~`` expanded; one that is empty or not UTF-8, as records are, raises a ``ValueError``."""
    text = os.fsdecode(value)
    if not text:
        raise ValueError(f"`{name}` is empty; name a directory, or `.` for the working directory.")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"`{name}` is not UTF-8: {os.fsencode(text)!r}; choose another name.") from None
    return Path(os.path.expanduser(text))  # `Path.expanduser` fails for an unknown user; a shell leaves the text


def as_plain(value: Any, name: str) -> Any:
    """Return a setting, or a whole card of them, as what JSON holds: numbers, strings, lists, dicts with string keys.

    NumPy and torch scalars become numbers, arrays and tensors lists, dataclasses dicts, paths and dtypes strings. An
    entry that has no such form raises a ``ValueError`` with its name.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ValueError(f"`{name}` has the key {key!r}; keys must be strings.")
        return {str(key): as_plain(item, f"{name}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(item, f"{name}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, (str, os.PathLike, torch.dtype, torch.device)):
        return str(value)
    if isinstance(value, np.floating):  # the `tolist` of a long double is itself
        value = float(value)
    elif isinstance(value, (np.ndarray, np.generic, torch.Tensor)):
        value = value.tolist()
        if isinstance(value, list):
            return as_plain(value, name)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    raise ValueError(f"`{name}` cannot be stored as JSON: {value!r} is a {type(value).__name__}.")


def check_numbers(config: Any, *, minima: Mapping[str, int], maxima: Mapping[str, float]) -> None:
    """Convert the fields of a frozen dataclass that are an ``int`` or ``float`` to plain numbers in their range.

    A whole number is at least 1 unless ``minima`` says otherwise, a ``float`` at least 0 and at most what ``maxima``
    says. ``seed`` is from 0 to 2**32 - 1. ``None`` stays where the annotation allows it. Errors are those of
    :func:`as_int`.
    """
    for name, hint in get_type_hints(type(config)).items():
        value = getattr(config, name)
        kinds = get_args(hint) or (hint,)
        if value is None and NoneType in kinds:
            continue
        if name == "seed":
            value = as_int(value, name, minimum=0, maximum=MAX_SEED)
        elif int in kinds:
            value = as_int(value, name, minimum=minima.get(name, 1))
        elif float in kinds:
            value = as_float(value, name, minimum=0, maximum=maxima.get(name))
        object.__setattr__(config, name, value)


def read_entry(reader: object, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry that a loss or a transform reads; a ``KeyError`` lists the present ones."""
    value: Tensor | None = tensordict.get(key, None)
    if value is None:
        present = list(tensordict.keys(True, True))
        raise KeyError(f"{type(reader).__name__} needs the entry {key!r} and found {present}; set its keys.")
    return value


def _scalar(value: Any) -> Any:
    """Return the Python number of a scalar; a bool, an array or a non-number raises a TypeError here or later."""
    number = value.item() if getattr(value, "ndim", None) == 0 else value
    if isinstance(number, (bool, str, bytes)) or getattr(number, "ndim", 0) > 0:
        raise TypeError
    return number


def _require_range(number: float, value: Any, name: str, minimum: float | None, maximum: float | None) -> None:
    if minimum is not None and number < minimum:
        raise ValueError(f"`{name}` must be at least {minimum}, got {value!r}.")
    if maximum is not None and number > maximum:
        raise ValueError(f"`{name}` must be at most {maximum}, got {value!r}.")

"""Settings that are on, off, or left to what pays on this machine."""

from __future__ import annotations

from typing import Literal

Switch = Literal["auto", "on", "off"]


def check_switch(name: str, value: str) -> None:
    """Refuse anything but ``"auto"``, ``"on"`` and ``"off"``.

    Raises:
        ValueError: naming the setting and its value.
    """
    if value not in ("auto", "on", "off"):
        raise ValueError(f"`{name}` must be 'auto', 'on' or 'off', got {value!r}.")

"""In which colours a world is drawn; part of every request, card and configuration that has frames."""

from __future__ import annotations

from typing import Literal, get_args

#: ``"normal"`` draws a world as it is. ``"reversed_background"`` reverses the order of the red, green and blue values
#: of the background (skybox and floor), the paper's unseen colours; ``"reversed_image"`` that of whole images.
Colors = Literal["normal", "reversed_background", "reversed_image"]

COLORS: tuple[str, ...] = get_args(Colors)


def is_drawn(stored: Colors, wanted: Colors) -> bool:
    """Whether a picture in the wanted colours must be drawn: it cannot be made of the stored one."""
    return stored != wanted and {stored, wanted} != {"normal", "reversed_image"}

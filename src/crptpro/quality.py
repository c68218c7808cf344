"""How carefully frames are rendered; part of every request, card and configuration that has frames."""

from __future__ import annotations

from typing import Literal, get_args

#: ``"exact"`` renders the model as it is; ``"fast"`` uses smaller shadow maps, up to twice as fast on software
#: GL, with fewer than 1 % of the pixels changed (8 % on the terrain of quadruped_escape).
Quality = Literal["exact", "fast"]

QUALITIES: tuple[str, ...] = get_args(Quality)

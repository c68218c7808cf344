"""A Gymnasium world that paints its clock without GL; importing this module registers it."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from crptpro.domains import Domain


class Painter(gymnasium.Env[np.ndarray, np.ndarray]):
    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, render_mode: str = ""):
        self.render_mode, self.clock = render_mode, 0
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.clock = 0
        return np.zeros(1), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.clock += 1
        return np.zeros(1), 0.0, False, False, {}

    def render(self) -> Any:
        return np.full((8, 8, 3), self.clock, np.uint8)


gymnasium.register("CrptproToyPainter-v0", Painter, max_episode_steps=6, disable_env_checker=True)


def _imports_this_module() -> None:
    """Sent to worker processes with the domain, so that they register the world too."""


PAINTER = Domain(
    "painter",
    "gymnasium:CrptproToyPainter-v0",
    camera=None,
    make=_imports_this_module,  # type: ignore[arg-type]
    source="gymnasium",
)

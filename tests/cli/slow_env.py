"""A plugin: an environment that takes its time, and an experiment that collects from it."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np

from crptpro.experiments.matrix import EXPERIMENTS, Cell, Experiment, Request, dataset

ENV_ID = "SlowEnv-v0"


class SlowEnv(gymnasium.Env):
    """A shade of grey that the action sets."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,))
    render_mode, shade = "rgb_array", 0.5

    def __init__(self, render_mode: str = "rgb_array") -> None: ...

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        time.sleep(0.02)
        self.shade = float(action[0] + 1) / 2
        return np.zeros(1, np.float32), self.shade, False, False, {}

    def render(self) -> Any:
        picture = np.full((16, 16, 3), int(255 * self.shade), np.uint8)
        picture[:8] = 0  # no flat colour
        return picture


gymnasium.register(ENV_ID, SlowEnv, max_episode_steps=20)


def slow(request: Request) -> list[Cell]:
    """A collection of some seconds."""
    return [Cell("slow", dataset(request.scale, f"gymnasium:{ENV_ID}", 0, 120), {"seed": 0})]


EXPERIMENTS["slow"] = Experiment("Slow", "A collection of some seconds.", slow)

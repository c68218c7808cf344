"""What every simulator behind :class:`~crptpro.envs.pixel_env.PixelEnv` must be able to do, with plain NumPy types."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np


class Outcome(NamedTuple):
    """What one agent step led to."""

    reward: float
    """Sum over the repeated env steps."""
    terminated: bool
    """The task ended: nothing follows this state."""
    truncated: bool
    """The episode was cut by a time limit; the state has a future."""


class Simulator(Protocol):
    """A world that is stepped with actions in [-1, 1] and photographed when asked.

    ``step`` never renders: the environment calls ``render`` once per agent step and once per reset.
    """

    action_size: int
    state_size: tuple[int, int] | None
    """(nq, nv) of the MuJoCo state, ``None`` for worlds without one."""

    def seed(self, seed: int) -> None:
        """Make the next ``reset`` and what follows it a function of ``seed``; changes nothing visible now."""

    def reset(self) -> None:
        """Start an episode."""

    def step(self, action: np.ndarray) -> Outcome:
        """Repeat ``action``, float ``[A]`` in [-1, 1], for one agent step, stopping where the episode ends."""

    def render(self) -> np.ndarray:
        """Return the current image, uint8 ``[H, W, 3]``; it may be overwritten by the next call."""

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ``qpos`` float64 ``[nq]`` and ``qvel`` float64 ``[nv]``."""

    def card(self) -> dict[str, Any]:
        """Return what a dataset's card should say about this world."""

    def close(self) -> None:
        """Free the render context; calling it twice is harmless."""

"""What a simulator behind :class:`~crptpro.envs.pixel_env.PixelEnv` must be able to do, in plain NumPy."""

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


class ActionRange:
    """The affine map from [-1, 1] to a simulator's own bounds.

    Args:
        low: Lower bounds, of the shape that the simulator takes.
        high: Upper bounds.
        dtype: What the simulator takes.

    Examples:
        >>> ActionRange(np.array([0.0, -1.0]), np.array([4.0, 1.0]))(np.array([0.5, -1.0]))
        array([ 3., -1.])
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, dtype: Any = np.float64):
        self._low = np.asarray(low, dtype=np.float64)
        self._half = (np.asarray(high, dtype=np.float64) - self._low) / 2.0
        self._dtype = dtype

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """Map ``action``, float ``[A]`` in [-1, 1]."""
        centred = action.astype(np.float64).reshape(self._low.shape) + 1.0
        return (self._low + self._half * centred).astype(self._dtype, copy=False)


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
        """Repeat ``action``, float ``[A]`` in [-1, 1], for one agent step, or up to the episode's end."""

    def render(self) -> np.ndarray:
        """Return the current image, uint8 ``[H, W, 3]``; it may be overwritten by the next call."""

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ``qpos`` float64 ``[nq]`` and ``qvel`` float64 ``[nv]``."""

    def card(self) -> dict[str, Any]:
        """Return what a dataset's card should say about this world."""

    def close(self) -> None:
        """Free the render context; calling it twice is harmless."""

"""Worlds without a renderer: a simulator that paints the time, and a dm_env environment that counts it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from crptpro.envs.simulator import Outcome


class FakeSimulator:
    """Paints ``10 * seed + agent_steps`` into a buffer that it reuses; ends after ``length`` agent steps."""

    def __init__(self, *, image_size: int = 8, length: int = 4, is_terminal: bool = False):
        self.action_size, self.state_size = 2, (3, 2)
        self.calls: list[str] = []
        self.agent_steps = self.episode_seed = self.next_seed = 0
        self._length, self._is_terminal = length, is_terminal
        self._buffer = np.zeros((image_size, image_size, 3), dtype=np.uint8)

    def seed(self, seed: int) -> None:
        self.calls.append("seed")
        self.next_seed = seed

    def reset(self) -> None:
        self.calls.append("reset")
        self.agent_steps, self.episode_seed = 0, self.next_seed

    def step(self, action: np.ndarray) -> Outcome:
        self.calls.append("step")
        assert action.dtype == np.float32
        self.agent_steps += 1
        is_over = self.agent_steps >= self._length
        return Outcome(0.5, is_over and self._is_terminal, is_over and not self._is_terminal)

    def render(self) -> np.ndarray:
        self.calls.append("render")
        self._buffer[:] = 10 * self.episode_seed + self.agent_steps
        self._buffer[0, :, 1] = 200  # the top row is greener: catches swapped axes
        return self._buffer

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        return np.full(3, float(self.agent_steps)), np.full(2, -float(self.agent_steps))

    def card(self) -> dict[str, Any]:
        return {"task": "fake"}

    def close(self) -> None:
        self.calls.append("close")


class FakeDmEnv(dm_env.Environment):
    """Ends after ``length`` env steps with the given discount; the reward is the number of the env step."""

    def __init__(self, *, length: int = 5, last_discount: float = 1.0):
        self._length, self._last_discount = length, last_discount
        self.env_steps = 0
        self.actions: list[np.ndarray] = []
        self.physics = SimpleNamespace(
            model=SimpleNamespace(nq=1, nv=1),
            data=SimpleNamespace(qpos=np.zeros(1), qvel=np.zeros(1)),
            free=lambda: None,
        )
        self.task = SimpleNamespace(random=np.random.RandomState(0))

    def reset(self) -> dm_env.TimeStep:
        self.env_steps = 0
        return dm_env.restart({})

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        self.env_steps += 1
        self.actions.append(action)
        if self.env_steps >= self._length:
            return dm_env.TimeStep(dm_env.StepType.LAST, float(self.env_steps), self._last_discount, {})
        return dm_env.transition(float(self.env_steps), {})

    def observation_spec(self) -> dict[str, Any]:
        return {}

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((2,), np.float64, [-1.0, -0.8], [1.1, 0.8])


class StubCamera:
    """Stands in for ``SceneCamera`` where the pixels do not matter."""

    def __init__(self, image_size: int = 8):
        self._image = np.zeros((image_size, image_size, 3), dtype=np.uint8)
        self.renders = 0

    def render(self, physics: Any) -> np.ndarray:
        self.renders += 1
        return self._image

    def release(self) -> None: ...

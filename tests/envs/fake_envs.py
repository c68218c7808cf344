"""Environments without a renderer: one of each library, whose answers a test sets."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from toy_env import ToyEnv

from crptpro.domains import Domain


class Painter(gymnasium.Env[np.ndarray, np.ndarray]):
    """Paints its seed's number and its clock; what it answers can be replaced by functions of the clock."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(0, 1, (1,))

    def __init__(
        self,
        action_space: Any = None,
        image: Callable[[int], Any] | None = None,
        reward: Callable[[int], Any] = float,
        answer: Callable[[int], Any] | None = None,
        end: int = 1000,
        render_mode: str = "",
    ):
        bounds = np.array([-2.0, 0.0]), np.array([2.0, 1.0])
        self.action_space = action_space or gymnasium.spaces.Box(*bounds, dtype=np.float64)
        self.image, self.reward, self.answer, self.end = image, reward, answer, end
        self.render_mode, self.clock, self.renders, self.actions = render_mode, 0, 0, list[np.ndarray]()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.clock, self.start = 0, int(self.np_random.integers(100))
        return np.zeros(1), {}

    def step(self, action: np.ndarray) -> Any:
        assert self.action_space.contains(action)
        self.actions.append(action)
        self.clock += 1
        if self.answer is not None:
            return self.answer(self.clock)
        return np.zeros(1), self.reward(self.clock), self.clock >= self.end, False, {}

    def render(self) -> Any:
        self.renders += 1
        if self.image is not None:
            return self.image(self.clock)
        return np.full((60, 80, 3), self.start + self.clock, np.uint8)


_numbers = itertools.count()


@contextmanager
def painter(max_episode_steps: int | None = 5, **options: Any) -> Iterator[str]:
    """Register a Painter, an episode of which has so many Gymnasium steps; gives its task's name."""
    name = f"CrptproPainter{next(_numbers)}-v0"
    limit = {"max_episode_steps": max_episode_steps}
    gymnasium.register(name, Painter, **limit, kwargs=options, disable_env_checker=True)
    try:
        yield f"gymnasium:{name}"
    finally:
        del gymnasium.registry[name]


class PlainEnv(ToyEnv):
    """A TorchRL environment of a user's; ``pixels`` and ``reward`` say what it emits at a clock."""

    def __init__(
        self,
        pixels: Callable[[int], torch.Tensor] | None = None,
        reward: Callable[[int], float] = float,
        *,
        length: int = 4,
        truncates: bool = True,
        dtype: torch.dtype = torch.float32,
        bound: float = 1.0,
        actions: int = 2,
    ):
        super().__init__(lambda seed: length, physics_state=True)
        self.pixels = pixels or (lambda clock: torch.full((3, 8, 8), 10 * self.episode_seed + clock, dtype=torch.uint8))
        self.reward, self.dtype_, self.count, self.total = reward, dtype, 0, 0.0
        shown = self.pixels(0)
        self.observation_spec["pixels"] = Bounded(0, 255, shape=shown.shape, dtype=shown.dtype)
        self.observation_spec["observation"] = Unbounded(shape=(2,))
        self.action_spec = Bounded(-bound, bound, shape=(actions,), dtype=dtype)
        self.reward_spec = Unbounded(shape=(1,), dtype=dtype)
        if not truncates:
            del self.done_spec["truncated"]

    def _observe(self) -> dict[str, torch.Tensor]:
        return super()._observe() | {"pixels": self.pixels(self.count), "observation": torch.zeros(2)}

    def _flags(self, terminated: bool, truncated: bool) -> dict[str, torch.Tensor]:
        flags = super()._flags(terminated, truncated)
        return {name: flags[name] for name in self.done_spec.keys()}  # noqa: SIM118

    def _step(self, tensordict: Any) -> TensorDict:
        assert tensordict["action"].dtype == self.dtype_
        found = super()._step(tensordict)
        return found.set("reward", torch.tensor([self.reward(self.count)], dtype=self.dtype_))


def own(make: Any, **settings: Any) -> Domain:
    """A domain of one's own."""
    return Domain("mine", "mine_go", make=make, **settings)

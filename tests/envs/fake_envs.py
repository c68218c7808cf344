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
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

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


class PlainEnv(EnvBase):
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
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self.pixels = pixels or (lambda clock: torch.full((3, 8, 8), 10 * self.seed + clock, dtype=torch.uint8))
        self.reward, self.length, self.truncates, self.dtype_ = reward, length, truncates, dtype
        self.seed = self.clock = 0
        shown = self.pixels(0)
        self.observation_spec = Composite(
            pixels=Bounded(0, 255, shape=shown.shape, dtype=shown.dtype),
            qpos=Unbounded(shape=(1,), dtype=torch.float64),
            observation=Unbounded(shape=(2,)),
        )
        self.action_spec = Bounded(-bound, bound, shape=(actions,), dtype=dtype)
        self.reward_spec = Unbounded(shape=(1,), dtype=dtype)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        names = ("done", "terminated", "truncated") if truncates else ("done", "terminated")
        self.done_spec = Composite({name: flag.clone() for name in names})

    def _observe(self, is_over: bool) -> dict[str, torch.Tensor]:
        over, never = torch.tensor([is_over]), torch.tensor([False])
        flags = {"done": over, "terminated": never if self.truncates else over}
        flags |= {"truncated": over} if self.truncates else {}
        qpos = torch.tensor([float(self.clock)], dtype=torch.float64)
        return {"pixels": self.pixels(self.clock), "qpos": qpos, "observation": torch.zeros(2), **flags}

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        self.clock = 0
        return TensorDict(self._observe(False), [])

    def _step(self, tensordict: Any) -> TensorDict:
        assert tensordict["action"].dtype == self.dtype_
        self.clock += 1
        reward = torch.tensor([self.reward(self.clock)], dtype=self.dtype_)
        return TensorDict({**self._observe(self.clock >= self.length), "reward": reward}, [])

    def _set_seed(self, seed: int | None) -> None:
        self.seed = seed or 0


def own(make: Any, **settings: Any) -> Domain:
    """A domain of one's own."""
    return Domain("mine", "mine_go", make=make, **settings)

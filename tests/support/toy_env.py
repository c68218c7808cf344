"""An environment without a simulator: its pixels are a function of seed, time and actions alone."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import absl.logging
import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from crptpro.data import FrameDataset
from crptpro.domains import Domain


class ToyEnv(EnvBase):
    """Episodes of ``lengths(seed)`` transitions; an even length ends by truncation, an odd by termination."""

    def __init__(
        self,
        lengths: Callable[[int], int],
        *,
        seed: int = 0,
        image_size: int = 8,
        physics_state: bool = False,
        on_step: Callable[[int], None] | None = None,
    ):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self.lengths, self.image_size = lengths, image_size
        self.on_step = on_step or (lambda count: None)
        self.physics_state, self.episode_seed, self.resets, self.steps = physics_state, seed, 0, 0
        observation = {"pixels": Bounded(0, 255, shape=(3, image_size, image_size), dtype=torch.uint8)}
        if physics_state:
            observation["qpos"] = Unbounded(shape=(2,), dtype=torch.float64)
            observation["qvel"] = Unbounded(shape=(1,), dtype=torch.float64)
        self.observation_spec = Composite(observation)
        self.action_spec = Bounded(-1.0, 1.0, shape=(2,), dtype=torch.float32)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float32)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def _observe(self) -> dict[str, Tensor]:
        rng = np.random.default_rng([self.episode_seed, self.count, int(abs(self.total) * 1e6)])
        shape = (3, self.image_size, self.image_size)
        found = {"pixels": torch.from_numpy(rng.integers(0, 256, shape, dtype=np.uint8))}
        if self.physics_state:
            found["qpos"] = torch.tensor([self.count, self.total], dtype=torch.float64)
            found["qvel"] = torch.tensor([float(self.episode_seed)], dtype=torch.float64)
        return found

    def _flags(self, terminated: bool, truncated: bool) -> dict[str, Tensor]:
        flags = {"done": terminated or truncated, "terminated": terminated, "truncated": truncated}
        return {name: torch.tensor([value]) for name, value in flags.items()}

    def _reset(self, tensordict: TensorDict | None = None, **kwargs: object) -> TensorDict:
        self.count, self.total, self.resets = 0, 0.0, self.resets + 1
        return TensorDict({**self._observe(), **self._flags(False, False)}, batch_size=[])

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.count += 1
        self.steps += 1
        self.on_step(self.count)
        self.total += float(tensordict["action"].sum())
        length = self.lengths(self.episode_seed)
        is_last = self.count >= length
        flags = self._flags(is_last and length % 2 == 1, is_last and length % 2 == 0)
        reward = torch.tensor([self.total], dtype=torch.float32)
        return TensorDict({**self._observe(), "reward": reward, **flags}, batch_size=[])

    def _set_seed(self, seed: int | None) -> None:
        self.episode_seed = seed or 0


class PoisonedEnv(ToyEnv):
    """Rewards NaN once, in the fourth step of its second episode of ten, unwatched."""

    def _step(self, tensordict: TensorDict) -> TensorDict:
        found = super()._step(tensordict)
        return found.set("reward", torch.full((1,), torch.nan)) if self.steps == 14 else found


class UncopiableError(Exception):
    """Cannot be made again from its message, as unpickling would."""

    def __init__(self, seed: int, place: str):
        super().__init__(f"no seed {seed} in {place}")


class SeedlessEnv(ToyEnv):
    """Its seeding fails, outside reset and step."""

    def _set_seed(self, seed: int | None) -> None:
        if seed:
            raise UncopiableError(seed, "the catalogue")


def fixed_length(seed: int) -> int:
    return 10


def variable_length(seed: int) -> int:
    return 3 + seed % 9


def _pause_like_a_renderer(count: int) -> None:
    time.sleep(0.01)


def _die(count: int) -> None:
    if count == 5:
        os._exit(7)


def _warn_like_dm_control(count: int) -> None:
    absl.logging.warning("Failed to converge after 99 steps")


def _fail(count: int) -> None:
    if count == 5:
        raise ValueError("the simulator exploded")


def make_toy(
    lengths: Any, on_step: Any = None, kind: type[ToyEnv] = ToyEnv, *, seed: int, image_size: int, physics_state: bool
) -> EnvBase:
    return kind(lengths, seed=seed, image_size=image_size, physics_state=physics_state, on_step=on_step)


FIXED = Domain("toy-fixed", "toy-fixed_go", make=partial(make_toy, fixed_length), episode_env_steps=10)
VARIABLE = Domain("toy-variable", "toy-variable_go", make=partial(make_toy, variable_length))
SLOW = Domain("toy-slow", "toy-slow_go", make=partial(make_toy, variable_length, _pause_like_a_renderer))
WARNING = Domain("toy-warning", "toy-warning_go", make=partial(make_toy, fixed_length, _warn_like_dm_control))
DYING = Domain("toy-dying", "toy-dying_go", make=partial(make_toy, fixed_length, _die))
FAILING = Domain("toy-failing", "toy-failing_go", make=partial(make_toy, fixed_length, _fail))
SEEDLESS = Domain("toy-seedless", "toy-seedless_go", make=partial(make_toy, fixed_length, None, SeedlessEnv))


def rollout_of(
    frames: Tensor, *, action: Tensor | None = None, reward: Tensor | None = None, end: str = "truncated", **extra: Any
) -> TensorDict:
    """The rollout ``[T]`` of T + 1 frames; it ends by ``"truncated"``, ``"terminated"`` or not at all (``""``)."""
    length = len(frames) - 1
    flags = {name: torch.zeros(length, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
    if end:
        flags["done"][-1] = flags[end][-1] = True
    action = torch.zeros(length, 1) if action is None else action
    reward = torch.zeros(length, 1) if reward is None else reward.reshape(length, 1)
    following = TensorDict({"pixels": frames[1:], "reward": reward, **flags}, [length])
    return TensorDict({"pixels": frames[:-1], "action": action, "next": following, **extra}, [length])


def random_episode(length: int, *, size: int = 6, seed: int = 0, action_dim: int = 2, state: bool = True) -> TensorDict:
    """The rollout ``[length]`` of an episode of random bytes; ends by truncation."""
    rng = np.random.default_rng(seed)
    physics = {"qpos": rng.normal(size=(length + 1, 4)), "qvel": rng.normal(size=(length + 1, 3))}
    frames = torch.from_numpy(rng.integers(0, 256, (length + 1, 3, size, size), dtype=np.uint8))
    action = torch.from_numpy(rng.uniform(-1, 1, (length, action_dim)).astype(np.float32))
    reward = torch.from_numpy(rng.normal(size=length).astype(np.float32))
    rollout = rollout_of(frames, action=action, reward=reward)
    for name, values in physics.items() if state else ():
        rollout[name], rollout["next", name] = torch.from_numpy(values[:-1]), torch.from_numpy(values[1:])
    return rollout


def data_bytes(path: Path) -> dict[str, bytes]:
    """The bytes of every data file of a dataset."""
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*.memmap"))}


def collection_request(**changes: Any) -> dict[str, Any]:
    """What ``FrameDataset.create`` is asked for by the collection of a toy environment."""
    settings = {"image_size": 8, "action_repeat": 2, "camera": 0, "quality": "exact", "colors": "normal"}
    return {"domain": "toy", "task": "toy_go", "seed": 0, "transitions": 27, **settings} | changes


def write_dataset(path: Path, episodes: Iterable[TensorDict], **request: Any) -> Path:
    """Write rollouts of whole episodes as collection does, as a complete dataset unless ``transitions`` are more."""
    episodes = list(episodes)
    asked = collection_request(transitions=sum(map(len, episodes)), image_size=episodes[0]["pixels"].shape[-1])
    dataset = FrameDataset.create(path, **asked | request)
    for episode in episodes:
        dataset.extend(episode)
        dataset.writer.end_episode()
    dataset.writer.close()
    return path


def collect_toy(path: Path, *, episodes: int | None = None, **request: Any) -> Path:
    """Begin or continue a dataset of random episodes: all that are asked for, or only so many."""
    asked = collection_request(**request)
    dataset = FrameDataset.create(path, **asked)
    writer: Any = dataset.writer
    while not dataset.is_complete and (index := writer.episodes) != episodes:
        dataset.extend(random_episode(10 - index % 4, size=asked["image_size"], seed=index, state=False))
    if not dataset.is_complete:
        writer.close()
    return path


def record(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV without what depends on the clock or the machine."""
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    return table.loc[:, ~table.columns.str.contains("time|per_s|bytes")].to_dict("records")

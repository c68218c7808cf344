"""Image-like episodes, datasets and a world, without a simulator.

``benchmarks.revisions`` imports this file in checkouts of other revisions too.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import CatFrames, EnvBase, TransformedEnv

ACTION_DIM = 6
"""Of the cheetah."""
_PATCHES = 12
"""Side of the noise that is blown up to an image: patches of a few pixels, as rendered scenes have."""


def drifting_episode(
    transitions: int, *, seed: int, image_size: int = 84, action_dim: int = ACTION_DIM
) -> TensorDict:
    """Return a rollout ``[T]`` of single frames: one smooth picture that drifts by a pixel or two per transition.

    No two of its frames are equal while there are fewer than ``image_size ** 2``. It is truncated at its end.
    """
    rng = np.random.default_rng(seed)
    scene = _picture(rng, image_size)
    pixels = torch.from_numpy(np.stack([_drifted(scene, t) for t in range(transitions + 1)]))
    action = torch.from_numpy(rng.uniform(-1, 1, (transitions, action_dim)).astype(np.float32))
    reward = torch.from_numpy(rng.uniform(0, 1, (transitions, 1)).astype(np.float32))
    truncated = torch.zeros(transitions, 1, dtype=torch.bool)
    truncated[-1] = True
    flags = {"done": truncated, "terminated": torch.zeros_like(truncated), "truncated": truncated}
    following = TensorDict({"pixels": pixels[1:], "reward": reward, **flags}, [transitions])
    return TensorDict({"pixels": pixels[:-1], "action": action, "next": following}, [transitions])


def episodes(transitions: int, *, seed: int = 0, length: int = 500, **sizes: int) -> Iterator[TensorDict]:
    """Yield whole episodes and one with the rest; ``sizes`` are those of :func:`drifting_episode`."""
    for number, first in enumerate(range(0, transitions, length)):
        yield drifting_episode(min(length, transitions - first), seed=1_000 * seed + number, **sizes)


def write_dataset(
    path: Path, *, transitions: int, seed: int = 0, image_size: int = 84, length: int = 500
) -> Path:
    """Write a dataset of drifting pictures that :meth:`crptpro.data.FrameDataset.open` reads; returns ``path``."""
    from crptpro.data import FrameDataset

    about: dict[str, Any] = {"task": "drifting_picture", "seed": seed, "action_repeat": 2}
    dataset = FrameDataset.create(path, domain=path.name, transitions=transitions, **about)
    for episode in episodes(transitions, seed=seed, image_size=image_size, length=length):
        dataset.extend(episode)
    return path


class DriftingWorld(EnvBase):
    """Single frames of a drifting picture, in episodes of a fixed length; its steps cost next to nothing."""

    def __init__(self, *, seed: int = 0, image_size: int = 84, length: int = 500) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self.length, self.image_size = length, image_size
        self._set_seed(seed)
        shape = (3, image_size, image_size)
        self.observation_spec = Composite(pixels=Bounded(0, 255, shape=shape, dtype=torch.uint8))
        self.action_spec = Bounded(-1.0, 1.0, shape=(ACTION_DIM,), dtype=torch.float32)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float32)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def _look(self, is_last: bool = False) -> dict[str, Tensor]:
        end = torch.tensor([is_last])
        flags = {"done": end, "terminated": torch.zeros_like(end), "truncated": end.clone()}
        return {"pixels": torch.from_numpy(_drifted(self.scene, self.count)), **flags}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        self.count = 0
        return TensorDict(self._look(), [])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.count += 1
        reward = tensordict["action"].mean().reshape(1).abs()
        return TensorDict({**self._look(self.count >= self.length), "reward": reward}, [])

    def _set_seed(self, seed: int | None) -> None:
        self.scene = _picture(np.random.default_rng(seed or 0), self.image_size)


def make_drifting(*, seed: int, image_size: int) -> EnvBase:
    """Build the world of a :class:`crptpro.domains.Domain`."""
    return DriftingWorld(seed=seed, image_size=image_size)


def make_drifting_env(
    task: object, *, seed: int, image_size: int = 84, frame_stack: int = 3, length: int = 500, **ignored: object
) -> EnvBase:  # fmt: skip
    """Build the world with stacks of frames, called as :func:`crptpro.envs.make_env` is."""
    world = DriftingWorld(seed=seed, image_size=image_size, length=length)
    return TransformedEnv(world, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


def _drifted(scene: np.ndarray, t: int) -> np.ndarray:
    return np.roll(scene, (t, 2 * t + t // scene.shape[1]), axis=(1, 2))


def _picture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return noise of a few large patches, interpolated, with a little grain: uint8 ``[3, size, size]``."""
    coarse = rng.uniform(20, 235, (3, _PATCHES, _PATCHES))
    at = np.linspace(0, _PATCHES - 1, size)
    low = np.minimum(at.astype(int), _PATCHES - 2)
    share = at - low
    rows = coarse[:, low] * (1 - share)[:, None] + coarse[:, low + 1] * share[:, None]
    smooth = rows[:, :, low] * (1 - share) + rows[:, :, low + 1] * share
    return (smooth + rng.normal(0, 3, smooth.shape)).clip(0, 255).astype(np.uint8)

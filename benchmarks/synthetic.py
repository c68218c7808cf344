"""An environment without a simulator, one smooth picture that drifts at next to no cost, and its datasets."""

from __future__ import annotations

import functools
from pathlib import Path

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from crptpro.data import collect_random
from crptpro.domains import Domain, register_domain

ACTION_DIM = 6
"""Of the cheetah."""
LENGTH = 500
"""Transitions of an episode."""
_PATCHES = 12
"""Side of the noise that is upscaled to an image: patches of a few pixels, as rendered scenes have."""


class DriftingEnv(EnvBase):
    """Single frames of a drifting picture. No two frames of an episode are equal (below ``image_size ** 2``)."""

    def __init__(self, *, seed: int, image_size: int, action_dim: int) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self.image_size, self.count = image_size, 0
        self._set_seed(seed)
        shape = (3, image_size, image_size)
        self.observation_spec = Composite(pixels=Bounded(0, 255, shape=shape, dtype=torch.uint8))
        self.action_spec = Bounded(-1.0, 1.0, shape=(action_dim,), dtype=torch.float32)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float32)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def _look(self) -> dict[str, Tensor]:
        end, t = torch.tensor([self.count >= LENGTH]), self.count
        frame = self.scene.roll((t, 2 * t + t // self.image_size), (1, 2))
        flags = {"done": end, "terminated": torch.zeros_like(end), "truncated": end.clone()}
        return {"pixels": frame, **flags}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        self.count = 0
        return TensorDict(self._look(), [])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.count += 1
        reward = tensordict["action"].mean().reshape(1).abs()
        return TensorDict({**self._look(), "reward": reward}, [])

    def _set_seed(self, seed: int | None) -> None:
        rng = torch.Generator().manual_seed(seed or 0)
        coarse = 20 + 215 * torch.rand(1, 3, _PATCHES, _PATCHES, generator=rng)
        smooth = F.interpolate(coarse, self.image_size, mode="bilinear")[0]
        grain = 3 * torch.randn(smooth.shape, generator=rng)
        self.scene = (smooth + grain).clamp(0, 255).to(torch.uint8)


def make_drifting(action_dim: int = ACTION_DIM, *, seed: int, image_size: int = 84, action_repeat: int = 2) -> EnvBase:
    """Build the environment of a domain; an agent step counts as ``action_repeat`` env steps."""
    return DriftingEnv(seed=seed, image_size=image_size, action_dim=action_dim)


register_domain(Domain("drifting", "drifting_task", make=make_drifting, action_repeat=2, episode_env_steps=2 * LENGTH))


def drifting_dataset(
    root: Path | str, *, transitions: int, image_size: int = 84, seed: int = 0, action_dim: int = ACTION_DIM,
) -> Path:  # fmt: skip
    """Collect a dataset of the environment in one process, or return it at once where it is complete."""
    make = functools.partial(make_drifting, action_dim)
    domain = Domain(f"drifting_{seed}", "drifting_go", make=make, action_repeat=2, episode_env_steps=2 * LENGTH)
    return collect_random(domain, root, seed=seed, progress=False, transitions=transitions, image_size=image_size)

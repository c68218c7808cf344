"""The environment that a training loop acts in, in its own thread, and its replay."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from crptpro.data import FrameReplay
from crptpro.domains import Domain, get_domain
from crptpro.envs import make_env, needs_gl
from crptpro.envs.rendering import select_backend
from crptpro.modules.encoder import images_of
from crptpro.provenance import cpu_cores
from crptpro.training.run import Run
from crptpro.workers import Inline, single_core_threads

SPARE_FRAMES = 2_000


class EnvThread:
    """Makes, steps and closes one environment in its own thread, which has its render context.

    MuJoCo lets other threads run while it simulates and renders: the next observation is rendered while an update
    computes. This changes no number. Without spare cores, and with GLFW, the caller's thread does everything.
    ``make_env`` builds another one like ``env``, with images of the encoder's size and frame stack.
    """

    def __init__(self, task: str | Domain, encoder: Any, config: Any, *, seed: int, action_repeat: int) -> None:
        domain = get_domain(task)  # the object: its name may be registered in this process only
        self.make_env: Callable[[], EnvBase] = functools.partial(
            make_env,
            domain,
            seed=seed,
            quality=config.quality,
            colors=getattr(config, "colors", "normal"),
            action_repeat=action_repeat,
            **images_of(encoder),
        )
        # If torch is limited to one thread, the cores are for other work.
        has_cores = cpu_cores() > 1 and torch.get_num_threads() > 1
        runs_ahead = has_cores and not (needs_gl(domain) and select_backend() == "glfw")
        self._thread = single_core_threads(1, "environment") if runs_ahead else Inline()
        self.env: EnvBase = self._thread.submit(self.make_env).result()

    def reset(self, seed: int) -> TensorDictBase:
        """Seed the environment and begin the episode of the seed."""
        self._thread.submit(self.env.set_seed, seed).result()
        return self._thread.submit(self.env.reset).result()

    def step(self, td: TensorDictBase) -> Future[TensorDictBase]:
        """Begin the step of ``td["action"]``; ``td`` may not change until the result is available."""
        return self._thread.submit(self.env.step, td)

    def uniform_action(self, generator: torch.Generator) -> Tensor:
        """Return a uniformly random action in ``[-1, 1]^A``."""
        return 2 * torch.rand(self.env.action_spec.shape, generator=generator, device="cpu") - 1

    def close(self) -> None:
        with self._thread:
            self._thread.submit(self.env.close).result()


def make_replay(run: Run, path: Path | None, env: EnvBase, capacity: int, **options: Any) -> FrameReplay:
    """Return the replay of an environment, in ``path`` or in RAM."""
    channels, height, width = env.observation_spec["pixels"].shape
    if path is not None and not run.saved:
        for file in path.glob("*.memmap*"):  # of an attempt without a checkpoint
            file.unlink()
    return FrameReplay(
        capacity,
        frame_shape=(3, height, width),
        action_dim=env.action_spec.shape[-1],
        frame_stack=channels // 3,
        path=path,
        **options,
    )

"""A TorchRL environment that emits one uint8 CHW image per agent step, over any :class:`Simulator`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from crptpro.envs.simulator import Simulator


class PixelEnv(EnvBase):
    """Unbatched CPU environment: ``pixels`` uint8 ``[3, H, W]``, ``action`` float32 ``[A]`` in [-1, 1].

    ``reset`` and ``step`` render exactly once each. Reward is float32 ``[1]``; ``terminated`` and
    ``truncated`` are told apart and ``done`` is their disjunction. With ``physics_state`` also ``qpos``
    float64 ``[nq]`` and ``qvel`` float64 ``[nv]``, where the simulator has them.

    Args:
        simulator: The world; owned by the environment from now on.
        image_size: H = W, pixels.
        physics_state: Emit ``qpos`` and ``qvel``.
        render: ``False`` leaves every image black and draws nothing.
    """

    def __init__(
        self, simulator: Simulator, *, image_size: int, physics_state: bool = False, render: bool = True
    ):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self.simulator = simulator
        self._render = render
        self._emit_state = physics_state and simulator.state_size is not None
        observation = {"pixels": Bounded(0, 255, shape=(3, image_size, image_size), dtype=torch.uint8)}
        if self._emit_state:
            nq, nv = simulator.state_size  # type: ignore[misc]
            observation["qpos"] = Unbounded(shape=(nq,), dtype=torch.float64)
            observation["qvel"] = Unbounded(shape=(nv,), dtype=torch.float64)
        self.observation_spec = Composite(observation)
        self.action_spec = Bounded(-1.0, 1.0, shape=(simulator.action_size,), dtype=torch.float32)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float32)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def card(self) -> dict[str, Any]:
        """Return the simulator's card: source, camera, render quality and whatever else shapes the pixels."""
        return self.simulator.card()

    def _observe(self) -> dict[str, torch.Tensor]:
        if self._render:
            # The transpose makes the copy that the simulator's reused buffer needs.
            image = np.ascontiguousarray(self.simulator.render().transpose(2, 0, 1))
            observation = {"pixels": torch.from_numpy(image)}
        else:
            observation = {"pixels": self.observation_spec["pixels"].zero()}
        if self._emit_state:
            qpos, qvel = self.simulator.state()
            observation["qpos"] = torch.tensor(qpos, dtype=torch.float64)
            observation["qvel"] = torch.tensor(qvel, dtype=torch.float64)
        return observation

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self.simulator.reset()
        return TensorDict({**self._observe(), **_flags(False, False)}, batch_size=[])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        outcome = self.simulator.step(tensordict.get("action").numpy())
        reward = torch.tensor([outcome.reward], dtype=torch.float32)
        flags = _flags(outcome.terminated, outcome.truncated)
        return TensorDict({**self._observe(), "reward": reward, **flags}, batch_size=[])

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.simulator.seed(seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulator and its render context; calling it twice is harmless."""
        self.simulator.close()
        super().close(raise_if_closed=False)


def _flags(terminated: bool, truncated: bool) -> dict[str, torch.Tensor]:
    return {
        "done": torch.tensor([terminated or truncated]),
        "terminated": torch.tensor([terminated]),
        "truncated": torch.tensor([truncated]),
    }

"""An end for episodes that have none of their own."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.envs import Transform


class EpisodeLimit(Transform):
    """Truncates an unbatched environment's episode after so many agent steps.

    TorchRL's ``StepCounter`` does the same and adds a ``step_count`` to every observation, which a replay would store.

    Args:
        agent_steps: decisions after which an episode is truncated, at least 1.
    """

    def __init__(self, agent_steps: int) -> None:
        super().__init__()
        self.agent_steps = agent_steps
        self.taken = 0

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self.taken = 0
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.taken += 1
        if self.taken >= self.agent_steps:
            for flag in ("truncated", "done"):
                next_tensordict.set(flag, torch.ones_like(next_tensordict.get(flag)))
        return next_tensordict

"""Stacks stored whole, and the random shift as one crop per sample: how pixel agents usually keep and augment data.

The layout is that of the released agents of CRPTpro and Proto-RL (``replay_buffer.py``): ``obs`` and ``next_obs``,
nine channels each, 127 KB per transition of 84x84. The shift is the batch-wise integer crop (windows of the padded
image, picked by index), on uint8. Interpolating with ``grid_sample`` in float32, as DrQ-v2 does, takes several times
as long and is not exact; comparing with it would flatter us.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torchrl.data import ReplayBuffer

PAD = 4
_CHUNK = 1_000


class Batch(NamedTuple):
    """Transitions as the plain implementation passes them around.

    Attributes:
        obs: uint8 ``[B, 9, H, W]``.
        action: float32 ``[B, A]``.
        reward: float32 ``[B, 1]``.
        next_obs: uint8 ``[B, 9, H, W]``.
        not_terminated: float32 ``[B, 1]``; 0 where bootstrapping stops.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    not_terminated: Tensor


class StackedStore:
    """All transitions in memory, sampled uniformly with replacement.

    Args:
        content: every transition, stacks written out.
    """

    def __init__(self, content: Batch) -> None:
        self.content = content

    @classmethod
    def of(cls, buffer: ReplayBuffer, transitions: int) -> StackedStore:
        """Write out the first ``transitions`` of a buffer of ours, or all if it has fewer."""
        count = min(transitions, len(buffer))
        parts = [buffer[torch.arange(first, min(first + _CHUNK, count))] for first in range(0, count, _CHUNK)]
        action = torch.cat([part["action"] for part in parts])
        reward = torch.cat([part["next", "reward"] for part in parts])
        not_terminated = 1 - torch.cat([part["next", "terminated"] for part in parts]).float()
        shape = (count, *parts[0]["pixels"].shape[1:])
        obs, next_obs = torch.empty(shape, dtype=torch.uint8), torch.empty(shape, dtype=torch.uint8)
        for index, part in enumerate(parts):
            rows = slice(index * _CHUNK, index * _CHUNK + len(part))
            obs[rows], next_obs[rows] = part["pixels"], part["next", "pixels"]
        return cls(Batch(obs, action, reward, next_obs, not_terminated))

    def __len__(self) -> int:
        return len(self.content.obs)

    def sample(self, batch_size: int) -> Batch:
        """Draw a batch, not shifted."""
        index = torch.randint(len(self), (batch_size,))
        return Batch(*(column[index] for column in self.content))


def random_crop(images: Tensor, pad: int = PAD) -> Tensor:
    """Shift every image by its own random integer offset: :func:`crop` at uniform offsets."""
    return crop(images, torch.randint(0, 2 * pad + 1, (len(images), 2)), pad)


def crop(images: Tensor, offsets: Tensor, pad: int = PAD) -> Tensor:
    """Crop each image at its offset from its padded self, border replicated.

    Args:
        images: ``[B, C, H, W]``.
        offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.
        pad: width of the border.

    Returns:
        ``[B, C, H, W]``.
    """
    height, width = images.shape[-2:]
    padded = F.pad(images, (pad, pad, pad, pad), mode="replicate")
    windows = padded.unfold(2, height, 1).unfold(3, width, 1)  # (B, C, 9, 9, H, W), a view
    return windows[torch.arange(len(images)), :, offsets[:, 0], offsets[:, 1]]

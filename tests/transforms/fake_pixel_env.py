"""A small pixel environment without a simulator, and small networks that fit it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from toy_env import ToyEnv

from crptpro.modules import PixelEncoder, Projector, Prototypes

SIZE = 20


class FakePixelEnv(ToyEnv):
    """uint8 [9, 20, 20] noise, whatever the actions; truncated after 4 agent steps."""

    def __init__(self) -> None:
        super().__init__(lambda seed: 4, image_size=SIZE)
        self.observation_spec["pixels"] = Bounded(0, 255, (9, SIZE, SIZE), dtype=torch.uint8)

    def _observe(self) -> dict[str, Any]:
        self.total = 0.0
        frame = super()._observe()["pixels"]
        return {"pixels": torch.cat([frame, 255 - frame, frame // 2])}


def small_encoder(**changes: object) -> PixelEncoder:
    config = {"channels": (4, 6), "strides": (2, 1), "image_size": SIZE, **changes}
    return PixelEncoder(9, **config)


def small_heads(encoder: PixelEncoder, prototypes: int = 8, latent_dim: int = 5) -> tuple[Projector, Prototypes]:
    return Projector(encoder.feature_dim, latent_dim), Prototypes(prototypes, latent_dim)


class FakeReplay:
    """Observations by number, as a replay hands them out; remembers what it was asked for."""

    def __init__(self, count: int = 12) -> None:
        self.window = count
        self.frames = torch.randint(0, 256, (count, 9, SIZE, SIZE), dtype=torch.uint8)
        self.asked: list[int] = []

    def observations(self, numbers: torch.Tensor) -> torch.Tensor:
        self.asked += numbers.tolist()
        return self.frames[numbers % len(self.frames)]

    def batch(self, *lead: int, first: int = 0) -> TensorDict:
        """Numbers and pixels of random transitions."""
        number = torch.randint(first, first + len(self.frames) - 1, lead)
        rows = number % len(self.frames)
        following = {"number": number + 1, "pixels": self.frames[(rows + 1) % len(self.frames)]}
        return TensorDict({"number": number, "pixels": self.frames[rows], "next": following}, lead)

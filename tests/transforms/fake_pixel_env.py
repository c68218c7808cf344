"""A small pixel environment without a simulator, and small networks that fit it."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase

from crptpro.modules import PixelEncoder, Projector, Prototypes

SIZE = 20
EPISODE = 4
SKILLS = 3


class FakePixelEnv(EnvBase):
    """uint8 [9, 20, 20] noise and a skill that changes every second agent step; reward = mean action.

    Truncated after 4 agent steps.
    """

    def __init__(self) -> None:
        super().__init__(device="cpu")
        self.observation_spec = Composite(
            pixels=Bounded(0, 255, (9, SIZE, SIZE), dtype=torch.uint8),
            skill=OneHot(SKILLS, dtype=torch.float32),
        )
        self.action_spec = Bounded(-1.0, 1.0, (2,))
        self.reward_spec = Unbounded((1,))
        flag = Bounded(0, 1, (1,), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())
        self._rng = torch.Generator().manual_seed(0)
        self._count = 0

    def _pixels(self) -> torch.Tensor:
        return torch.randint(0, 256, (9, SIZE, SIZE), dtype=torch.uint8, generator=self._rng)

    def _skill(self) -> torch.Tensor:
        return torch.eye(SKILLS)[self._count // 2]

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        self._count = 0
        return TensorDict({"pixels": self._pixels(), "skill": self._skill()})

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._count += 1
        over = torch.tensor([self._count >= EPISODE])
        return TensorDict(
            {
                "pixels": self._pixels(),
                "skill": self._skill(),
                "reward": tensordict["action"].mean(-1, keepdim=True),
                "done": over,
                "truncated": over,
                "terminated": torch.zeros(1, dtype=torch.bool),
            }
        )

    def _set_seed(self, seed: int | None) -> None:
        self._rng.manual_seed(seed or 0)


def small_encoder(**changes: object) -> PixelEncoder:
    config = {"channels": (4, 6), "strides": (2, 1), "image_size": SIZE, **changes}
    return PixelEncoder(9, **config)


def small_heads(
    encoder: PixelEncoder, prototypes: int = 8, latent_dim: int = 5
) -> tuple[Projector, Prototypes]:
    return Projector(encoder.feature_dim, latent_dim), Prototypes(prototypes, latent_dim)


class FakeReplay:
    """Observations by number, as a replay hands them out; remembers what it was asked for."""

    def __init__(self, count: int = 12, window: int | None = None, size: int = SIZE) -> None:
        self.window = count if window is None else window
        self.frames = torch.randint(0, 256, (count, 9, size, size), dtype=torch.uint8)
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

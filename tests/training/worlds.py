"""Tiny datasets, losses and environments for tests of the training loops."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.modules import PixelEncoder, Projector, Prototypes
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import Pretrained

SIZE, EPISODE = 16, 10


def make_dataset(domain: int, *, transitions: int = 60) -> ReplayBuffer:
    """Smooth noise that drifts by one pixel per transition; the mean brightness tells the domain."""
    generator = torch.Generator().manual_seed(domain)
    base = torch.rand(transitions, 3, SIZE, SIZE, generator=generator) * 120 + 60 * domain
    pixels = base.to(torch.uint8)
    buffer = ReplayBuffer(storage=LazyTensorStorage(transitions))
    buffer.extend(TensorDict({"pixels": pixels, "next": {"pixels": pixels.roll(1, -1)}}, [transitions]))
    return buffer


def make_datasets() -> dict[str, ReplayBuffer]:
    return {"dark": make_dataset(0), "bright": make_dataset(1)}


def make_encoder(channels: int = 3) -> PixelEncoder:
    return PixelEncoder(channels, channels=(4, 4), strides=(2, 1), image_size=SIZE)


def make_loss(seed: int = 0, *, channels: int = 3, **options: Any) -> ProtoLoss:
    torch.manual_seed(seed)
    return ProtoLoss(
        make_encoder(channels), **{"num_prototypes": 8, "latent_dim": 8, "hidden_dim": 16, **options}
    )


def make_pretrained(method: str = "crptpro") -> Pretrained:
    torch.manual_seed(0)
    encoder = make_encoder(9)
    heads = {"projector": Projector(encoder.feature_dim, 4), "prototypes": Prototypes(8, 4)}
    return Pretrained(encoder, **heads, card={"method": method})


def make_toy_env(
    task: str, *, seed: int, image_size: int = SIZE, frame_stack: int = 3, **settings: object
) -> EnvBase:
    env = ToyEnv(lambda _: EPISODE, seed=seed, image_size=image_size)
    return TransformedEnv(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


def same_state(one: torch.nn.Module, two: torch.nn.Module) -> bool:
    """Bit equality of two modules, targets and coefficients included."""
    first, second = one.state_dict(), two.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


def record(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV without what depends on the clock or the machine."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    left_out = ("time", "per_s", "bytes")
    return [{k: v for k, v in row.items() if not any(part in k for part in left_out)} for row in rows]

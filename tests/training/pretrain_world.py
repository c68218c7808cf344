"""Two tiny domains in memory and a tiny loss, for tests of the pre-training loop."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss

SIZE = 16


def make_dataset(domain: int, *, transitions: int = 60) -> ReplayBuffer:
    """Smooth noise that drifts by one pixel per transition; the mean brightness tells the domain."""
    generator = torch.Generator().manual_seed(domain)
    base = torch.rand(transitions, 3, SIZE, SIZE, generator=generator) * 120 + 60 * domain
    pixels = base.to(torch.uint8)
    batch = TensorDict(
        {"pixels": pixels, "next": {"pixels": pixels.roll(1, -1)}, "action": torch.zeros(transitions, 2)},
        [transitions],
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(transitions), batch_size=8)
    buffer.extend(batch)
    return buffer


def make_datasets() -> dict[str, ReplayBuffer]:
    return {"dark": make_dataset(0), "bright": make_dataset(1)}


def make_loss(seed: int = 0, **options: Any) -> ProtoLoss:
    torch.manual_seed(seed)
    encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=SIZE)
    return ProtoLoss(encoder, **{"num_prototypes": 8, "latent_dim": 8, "hidden_dim": 16, **options})


SETTINGS: dict[str, Any] = {
    "batch_size": 8,
    "learning_rate": 1e-3,
    "seed": 3,
    "log_interval": 4,
    "checkpoint_interval": 5,
    "precision": "fp32",
    "progress": False,
}


def same_state(a: Any, b: Any) -> bool:
    """Bit equality of two losses, targets and coefficients included."""
    one, two = a.state_dict(), b.state_dict()
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)

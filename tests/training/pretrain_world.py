"""Two tiny domains in memory and a tiny loss, for tests of the pre-training loop."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import LossModule

from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.training import pretrain

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


TIMED = {"unix_time_s", "updates_per_s", "resident_bytes"}


def run(loss: LossModule, updates: int, datasets: Any = None, **options: Any) -> Any:
    return pretrain(loss, datasets or make_datasets(), updates=updates, **{**SETTINGS, **options})


def record(run_dir: Path) -> list[dict[str, str]]:
    with open(run_dir / "pretrain.csv") as file:
        return [{k: v for k, v in row.items() if k not in TIMED} for row in csv.DictReader(file)]


class Spy:
    """Notes the order in which datasets are sampled."""

    def __init__(self, name: str, dataset: Any, order: list[str]) -> None:
        self.name, self.dataset, self.order = name, dataset, order
        self.domain = name

    def sample(self, batch_size: int) -> TensorDictBase:
        self.order.append(self.name)
        return self.dataset.sample(batch_size)

    def set_rng(self, generator: torch.Generator) -> None:
        self.dataset.set_rng(generator)

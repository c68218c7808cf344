"""Tiny datasets, losses and environments for tests of the training loops."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from toy_env import ToyEnv, fixed_length

from crptpro.domains import Domain
from crptpro.modules import PixelEncoder, Projector, Prototypes, precision
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import Pretrained

SIZE, EPISODE = 16, 10
HERE = Path(__file__).parent


def make_dataset(domain: int, *, channels: int = 3, action_dim: int = 2) -> ReplayBuffer:
    """Noise that drifts by one pixel per transition; the mean brightness tells the domain."""
    generator = torch.Generator().manual_seed(domain)
    base = torch.rand(60, channels, SIZE, SIZE, generator=generator) * 120 + 60 * domain
    pixels = base.to(torch.uint8)
    buffer = ReplayBuffer(storage=LazyTensorStorage(60))
    rows = {"pixels": pixels, "action": torch.zeros(60, action_dim), "next": {"pixels": pixels.roll(1, -1)}}
    buffer.extend(TensorDict(rows, [60]))
    return buffer


def make_datasets() -> dict[str, ReplayBuffer]:
    return {"dark": make_dataset(0), "bright": make_dataset(1)}


def make_encoder(channels: int = 3) -> PixelEncoder:
    return PixelEncoder(channels, channels=(4, 4), strides=(2, 1), image_size=SIZE)


def make_loss(seed: int = 0, *, channels: int = 3, **options: Any) -> ProtoLoss:
    torch.manual_seed(seed)
    small = {"num_prototypes": 8, "latent_dim": 8, "hidden_dim": 16}
    return ProtoLoss(make_encoder(channels), **{**small, **options})


def make_pretrained(method: str = "crptpro") -> Pretrained:
    torch.manual_seed(0)
    encoder = make_encoder(9)
    heads = {"projector": Projector(encoder.feature_dim, 4), "prototypes": Prototypes(8, 4)}
    return Pretrained(encoder, **heads, card={"method": method})


class SmoothToyEnv(ToyEnv):
    """Its pictures do not depend on the actions, and its rewards depend on them smoothly."""

    def _observe(self) -> dict[str, torch.Tensor]:
        total, self.total = self.total, 0.0
        observed = super()._observe()
        self.total = total
        return observed


def make_toy(env: type[ToyEnv], on_step: Any, *, seed: int, image_size: int, action_repeat: int) -> EnvBase:
    return env(fixed_length, seed=seed, image_size=image_size, on_step=on_step)


def toy_domain(name: str, env: type[ToyEnv] = ToyEnv, on_step: Any = None) -> Domain:
    return Domain(name, f"{name}_go", make=partial(make_toy, env, on_step), action_repeat=2)


def signalling(name: str, step: int, number: signal.Signals) -> Domain:
    """An environment that sends a signal to this process with one of its steps."""
    steps = itertools.count(1)
    return toy_domain(name, on_step=lambda _: next(steps) == step and os.kill(os.getpid(), number))


def pretend_cpu(flags: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Let ``auto`` see a processor of these flags."""
    path = tmp_path / "cpuinfo"
    path.write_text(f"flags: {flags}")
    monkeypatch.setattr(precision, "CPUINFO", path)


def python(code: str) -> subprocess.CompletedProcess[str]:
    """Run a program that may import these tests' modules."""
    path = os.pathsep.join([str(HERE), str(HERE.parent / "training"), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def kill(code: str) -> None:
    """Run a program that kills itself."""
    found = python(f"import pathlib, signal, toy_runs\n{code}")
    assert found.returncode == -signal.SIGKILL, found.stderr


def same_state(one: torch.nn.Module, two: torch.nn.Module) -> bool:
    """Bit equality of two modules, targets and coefficients included."""
    first, second = one.state_dict(), two.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)

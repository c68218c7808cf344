"""Toy domains, a tiny loss and what is compared in tests of active pre-training."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.modules import PixelEncoder
from crptpro.objectives import get_method
from crptpro.training import ActiveConfig, ActiveResult, pretrain_active

LENGTHS = {"even": lambda seed: 10, "odd": lambda seed: 7, "varied": lambda seed: 3 + seed % 9}
SIZE = 16

SMALL = ActiveConfig(
    env_steps=240,
    batch_size=8,
    random_agent_steps=10,
    replay_capacity=1_000,
    bottleneck_dim=4,
    hidden_dim=16,
    queue_size=16,
    skill_agent_steps=4,
    log_interval=5,
    checkpoint_interval_env_steps=40,
    precision="fp32",
    render_ahead=False,
)


def toy_env(domain: str, *, seed: int, image_size: int, frame_stack: int, **settings: Any) -> EnvBase:
    env = ToyEnv(LENGTHS[domain], seed=seed, image_size=image_size)
    return TransformedEnv(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


def make_loss(method: str = "proto-rl-c", seed: int = 0, **options: Any) -> Any:
    torch.manual_seed(seed)
    chosen = get_method(method)
    small = {"channels": (4, 4), "strides": (2, 1), "image_size": SIZE}
    encoder = PixelEncoder(9, **{**small, **chosen.encoder_options})
    if method.startswith("proto"):
        options = {"num_prototypes": 8, "latent_dim": 4, "hidden_dim": 8, **options}
    elif method.startswith("apt"):
        options = {"latent_dim": 4, **options}
    else:
        options = {"hidden_dim": 8, **options}
    return chosen.build(encoder, **options)


def explore(
    run_dir: Path | None, domains: tuple[str, ...] = ("even", "odd"), loss: Any = None, **overrides: Any
) -> tuple[Any, ActiveResult]:
    loss = make_loss() if loss is None else loss
    factory = overrides.pop("env_factory", toy_env)
    resume = overrides.pop("resume", True)
    result = pretrain_active(
        loss,
        list(domains),
        run_dir=run_dir,
        config=dataclasses.replace(SMALL, **overrides),
        progress=False,
        resume=resume,
        env_factory=factory,
    )
    return loss, result


def same_state(one: torch.nn.Module, two: torch.nn.Module) -> bool:
    a, b = one.state_dict(), two.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return [
            {
                key: value
                for key, value in row.items()
                if "time" not in key and "per_s" not in key and "bytes" not in key
            }
            for row in csv.DictReader(file)
        ]

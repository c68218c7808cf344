"""Snapshots in the layouts of the original repositories, small, made by classes that are gone afterwards.

The classes are typed anew after the originals' attribute names; forward passes scale pixels as theirs do.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

PIXELS = torch.randint(0, 256, (3, 9, 84, 84), dtype=torch.uint8, generator=torch.Generator().manual_seed(7))

PROTO = """
import torch
from torch import nn

class Encoder(nn.Module):
    def __init__(self, channels=4, latent=8):
        super().__init__()
        c = channels
        self.conv = nn.Sequential(nn.Conv2d(9, c, 3, stride=2), nn.ReLU(), nn.Conv2d(c, c, 3, stride=1), nn.ReLU(),
                                  nn.Conv2d(c, c, 3, stride=1), nn.ReLU(), nn.Conv2d(c, c, 3, stride=1), nn.ReLU())
        self.repr_dim = c * 35 * 35
        self.projector = nn.Linear(self.repr_dim, latent)

    def encode(self, obs):
        return self.conv(obs / 255.0).flatten(1)

    def forward(self, obs):
        return self.projector(self.encode(obs))

class Proto(nn.Module):
    def __init__(self, latent=8, hidden=12, protos=16, queue=32):
        super().__init__()
        self.predictor = nn.Sequential(nn.Linear(latent, hidden), nn.ReLU(), nn.Linear(hidden, latent))
        self.T, self.topk, self.num_iters, self.num_protos = 0.2, 3, 3, protos
        self.protos = nn.Linear(latent, protos, bias=False)
        self.register_buffer("queue", torch.randn(queue, latent))
        self.register_buffer("queue_ptr", torch.tensor([16]))
        self.outputs = dict()

class Actor(nn.Module):
    def __init__(self):
        super().__init__()
        self.pre_fc = nn.Sequential(nn.Linear(4900, 5), nn.LayerNorm(5))

class ProtoAgent(object):
    def __init__(self, **proto):
        self.device, self.lr, self.batch_size, self.task_agnostic = torch.device("cpu"), 1e-4, 512, True
        self.action_range = [-1.0, 1.0]
        self.encoder, self.encoder_target, self.proto, self.actor = Encoder(), Encoder(), Proto(**proto), Actor()
        self.log_alpha = torch.tensor(-2.3, requires_grad=True)
        both = [*self.encoder.parameters(), *self.proto.parameters()]
        self.proto_optimizer = torch.optim.Adam(both, lr=self.lr)
        self.encoder.conv(torch.rand(1, 9, 84, 84)).sum().backward()
        self.proto_optimizer.step()  # so that the optimiser has a state, with parameters for keys
        self.aug = nn.Sequential(nn.ReplicationPad2d(4))
"""

# The fork counts its updates; the rest is the same.
CRPTPRO = PROTO.replace("self.outputs = dict()", "self.update_count = 49998")

URLB = """
import torch
from torch import nn

class Encoder(nn.Module):
    def __init__(self, channels=4):
        super().__init__()
        c = channels
        self.convnet = nn.Sequential(nn.Conv2d(9, c, 3, stride=2), nn.ReLU(), nn.Conv2d(c, c, 3, stride=1),
                                     nn.ReLU(), nn.Conv2d(c, c, 3, stride=1), nn.ReLU(),
                                     nn.Conv2d(c, c, 3, stride=1), nn.ReLU())

    def forward(self, obs):
        return self.convnet(obs / 255.0 - 0.5).flatten(1)

class DDPGAgent:
    def __init__(self):
        self.name, self.obs_type, self.lr, self.temperature = "ddpg", "pixels", 1e-4, 0.4
        self.encoder = Encoder()
        self.actor = nn.Sequential(nn.Linear(4900, 5), nn.LayerNorm(5), nn.Tanh())
        self.encoder_opt = torch.optim.Adam(self.encoder.parameters(), lr=1e-4)

class BECL(nn.Module):
    def __init__(self, features, skills, hidden):
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(features, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                                   nn.Linear(hidden, skills))
        self.project_head = nn.Sequential(nn.Linear(skills, hidden), nn.ReLU(), nn.Linear(hidden, skills))

    def forward(self, tau):
        return self.project_head(self.embed(tau))

class BECLAgent(DDPGAgent):
    def __init__(self):
        super().__init__()
        self.name, self.skill_dim = "becl", 6
        self.becl = BECL(4900, 6, 10)

class Projector(nn.Module):
    def __init__(self):
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(8, 12), nn.ReLU(), nn.Linear(12, 8))

class ProtoAgent(DDPGAgent):
    def __init__(self):
        super().__init__()
        self.name, self.tau = "proto", 0.2
        self.encoder_target = Encoder()
        self.predictor, self.predictor_target = nn.Linear(4900, 8), nn.Linear(4900, 8)
        self.projector = Projector()
        self.protos = nn.Linear(8, 16, bias=False)
        self.queue, self.queue_ptr = torch.randn(32, 8), 16
"""


@contextmanager
def module_file(folder: Path, name: str, source: str) -> Iterator[Any]:
    """Make a module importable under its original name, and gone afterwards."""
    parts = name.split(".")
    assert parts[0] not in sys.modules
    file = folder.joinpath(*parts).with_suffix(".py")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))
        for loaded in [module for module in sys.modules if module.split(".")[0] == parts[0]]:
            del sys.modules[loaded]


def save(content: Any, path: Path, *, is_legacy: bool) -> Path:
    """Write as the torch of those days, or as today's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.save(content, path, _use_new_zipfile_serialization=not is_legacy)
    return path


def atc_state(strides: tuple[int, ...] = (2, 2, 2, 1), features: int = 4 * 7 * 7) -> dict[str, Any]:
    """Return what rlpyt's runner saves; ``conv.conv`` is a Sequential inside its Conv2dModel."""

    def encoder() -> torch.nn.Module:
        convs: list[torch.nn.Module] = []
        for index, stride in enumerate(strides):
            convs += [torch.nn.Conv2d(4 if index else 9, 4, 3, stride), torch.nn.ReLU()]
        module = torch.nn.Module()
        module.conv, module.head = torch.nn.Module(), torch.nn.Module()
        module.conv.conv = torch.nn.Sequential(*convs)
        module.head.model = torch.nn.Sequential(torch.nn.Linear(features, 8))
        return module

    contrast = torch.nn.Module()
    contrast.anchor_mlp = torch.nn.Module()
    contrast.anchor_mlp.model = torch.nn.Sequential(
        torch.nn.Linear(8, 12), torch.nn.ReLU(), torch.nn.Linear(12, 8)
    )
    contrast.W = torch.nn.Linear(8, 8, bias=False)
    online = encoder()
    optimizer = torch.optim.Adam([*online.parameters(), *contrast.parameters()])
    return {
        "itr": 9_999,
        "algo_state_dict": {
            "encoder": online.state_dict(),
            "target_encoder": encoder().state_dict(),
            "contrast": contrast.state_dict(),
            "optimizer": optimizer.state_dict(),
        },
    }


def atc_forward(state: dict[str, Any], pixels: Tensor, strides: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return latents and flattened convolution output of rlpyt's encoder."""
    hidden = pixels.float().mul(1.0 / 255)
    for index, stride in enumerate(strides):
        weight, bias = state[f"conv.conv.{2 * index}.weight"], state[f"conv.conv.{2 * index}.bias"]
        hidden = torch.nn.functional.conv2d(hidden, weight, bias, stride).relu()
    hidden = hidden.flatten(1)
    return torch.nn.functional.linear(
        hidden, state["head.model.0.weight"], state["head.model.0.bias"]
    ), hidden

"""A checkout of the released agent is found and timed from the plain store, or refused in one line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from benchmarks.peer import load, peer_update
from benchmarks.plain import Batch

from crptpro.errors import CRPTproError

#: A checkout in the shape of the released ones, with an agent that learns nothing.
PEER_FILES = {
    "utils.py": "import gym\nfrom omegaconf import OmegaConf\n",
    "replay_buffer.py": """
import utils
class ReplayBuffer:
    def __init__(self, obs_shape, action_shape, capacity, device):
        self.capacity = capacity
""",
    "proto.py": """
import hydra
import kornia
import torch
from torch import nn
import utils

class Part(nn.Module):
    def __init__(self, **params):
        super().__init__()
        self.params = params

class Encoder(Part):
    repr_dim = 39200

Actor = Critic = Proto = Part

class ProtoAgent:
    def __init__(self, encoder_cfg, actor_cfg, batch_size, task_agnostic, **rest):
        self.encoder = hydra.utils.instantiate(encoder_cfg)
        actor_cfg.params.repr_dim = self.encoder.repr_dim
        self.actor = hydra.utils.instantiate(actor_cfg)
        self.batch_size, self.updates = batch_size, [task_agnostic]
        self.aug = nn.Sequential(nn.ReplicationPad2d(4), kornia.augmentation.RandomCrop((84, 84)))

    def update(self, replay_buffer, step):
        shifted = self.aug(torch.as_tensor(replay_buffer.obses[: self.batch_size]).float())
        assert shifted.shape[1:] == (9, 84, 84)
        assert self.actor.params["repr_dim"] == 39200
        self.updates.append(step)
        return self.updates
""",
}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, content in PEER_FILES.items():
        (tmp_path / name).write_text(content)
    return tmp_path


def store(image_size: int) -> Batch:
    images = torch.zeros(6, 9, image_size, image_size, dtype=torch.uint8)
    return Batch(images, torch.zeros(6, 2), torch.zeros(6, 1), images, torch.ones(6, 1))


def test_a_peer_updates_from_the_arrays_of_the_plain_store_and_its_import_leaves_no_trace(checkout: Path) -> None:
    before, path = set(sys.modules), list(sys.path)
    update = peer_update(checkout, store(84), batch_size=4, prototypes=16, task_agnostic=True)
    assert [update(step) for step in (2, 3)][-1] == [True, 2, 3]
    assert not {"utils", "proto", "replay_buffer", "hydra", "kornia", "gym"} & (set(sys.modules) - before)
    assert sys.path == path
    with pytest.raises(CRPTproError, match="takes images of 84 px, not 16"):
        peer_update(checkout, store(16), batch_size=4, prototypes=16, task_agnostic=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "ModuleNotFoundError.*--peer wants a checkout of liuxin0824/CRPTpro or denisyarats/proto."),
        ("import hydra\n", "defines no ProtoAgent"),
        ("import a_package_nobody_has\n", r"ModuleNotFoundError: .*a_package_nobody_has"),
    ],
)
def test_what_is_no_released_agent_is_one_clear_error(checkout: Path, content: str | None, message: str) -> None:
    (checkout / "proto.py").unlink()
    if content is not None:
        (checkout / "proto.py").write_text(content)
    with pytest.raises(CRPTproError, match=message):
        load(checkout)

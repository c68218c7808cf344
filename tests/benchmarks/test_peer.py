"""A checkout of the released agent is found and timed from the plain store, or refused in one line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from benchmarks.peer import Peer, RandomCrop, load
from benchmarks.plain_pretrain import StackedStore
from benchmarks.synthetic import write_dataset

from crptpro.data import FrameDataset
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
        self.batch_size, self.task_agnostic, self.updates = batch_size, task_agnostic, []
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
    path = tmp_path / "peer"
    path.mkdir()
    for name, content in PEER_FILES.items():
        (path / name).write_text(content)
    return path


def store(tmp_path: Path, image_size: int) -> StackedStore:
    path = write_dataset(tmp_path / f"toy_{image_size}", transitions=6, image_size=image_size)
    return StackedStore.of(FrameDataset.open(path), 6)


def test_a_peer_updates_from_the_arrays_of_the_plain_store(checkout: Path, tmp_path: Path) -> None:
    peer = Peer(checkout, batch_size=4, prototypes=16)
    large = store(tmp_path, 84)
    pretraining, downstream = peer.pretrain_update(large), peer.downstream_update(large)
    assert [pretraining() for _ in range(2)][-1] == [2, 2]
    assert [downstream() for _ in range(3)][-1] == [0, 1, 2]
    with pytest.raises(CRPTproError, match="takes images of 84 px, not 16"):
        peer.pretrain_update(store(tmp_path, 16))


def test_a_peer_imports_without_its_packages_and_leaves_no_trace(checkout: Path) -> None:
    before, path = set(sys.modules), list(sys.path)
    assert load(checkout).keys() == {"utils", "proto", "replay_buffer"}
    assert not {"utils", "proto", "replay_buffer"} & (set(sys.modules) - before)
    assert sys.path == path
    assert all(name in before for name in ("hydra", "kornia", "gym") if name in sys.modules)


def test_what_is_no_released_agent_is_one_clear_error(checkout: Path, tmp_path: Path) -> None:
    with pytest.raises(CRPTproError) as error:
        load(tmp_path)
    assert str(error.value) == (
        f"{tmp_path} has no proto.py, utils.py, replay_buffer.py: --peer wants a checkout of liuxin0824/CRPTpro or "
        "denisyarats/proto."
    )
    (checkout / "proto.py").write_text("import hydra\n")
    with pytest.raises(CRPTproError, match="defines no ProtoAgent"):
        load(checkout)
    (checkout / "proto.py").write_text("import a_package_nobody_has\n")
    with pytest.raises(CRPTproError, match=r"ModuleNotFoundError: .*a_package_nobody_has"):
        load(checkout)


def test_the_stand_in_crop_is_one_integer_crop_per_sample() -> None:
    torch.manual_seed(0)
    images = torch.arange(36.0).view(1, 1, 6, 6).expand(200, 1, 6, 6)
    corners = RandomCrop((4, 4))(images)[:, 0, 0, 0]
    assert corners.unique().tolist() == [0, 1, 2, 6, 7, 8, 12, 13, 14]

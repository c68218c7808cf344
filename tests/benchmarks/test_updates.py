"""The updates benchmark runs at a tiny size, prints its tables and writes its JSON; peers are found or refused."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import pytest
import torch
from benchmarks.library_updates import PretrainUpdates, fresh_loss, precisions
from benchmarks.peer import Peer, RandomCrop, load
from benchmarks.plain_store import StackedStore
from benchmarks.synthetic import write_dataset
from benchmarks.updates import Settings, main

from benchmarks import library_updates, updates
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.objectives import method_defaults
from crptpro.training import pretrain

TINY = Settings(
    rounds=1, warmup=1, threads=torch.get_num_threads(), batch_size=8, prototypes=16, image_size=16, domains=2,
    dataset_transitions=20, update_transitions=20, replay_transitions=20, agent_steps=6, sustained_updates=4,
)  # fmt: skip

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


def test_what_was_measured_is_kept_when_a_later_section_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise CRPTproError("too little memory")

    monkeypatch.setattr(updates, "measure_agent_step", fail)
    with pytest.raises(CRPTproError, match="too little memory"):
        main(dataclasses.replace(TINY, only=("downstream", "agent-step"), out=tmp_path))
    assert set(json.loads((tmp_path / "updates.json").read_text())["results"]) == {"downstream"}


def test_every_section_without_a_simulator_prints_a_table_and_lands_in_the_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = dataclasses.replace(TINY, only=("pretrain", "downstream", "sustained"), out=tmp_path)
    results = main(settings)
    content = json.loads((tmp_path / "updates.json").read_text())
    assert content["settings"]["batch_size"] == 8
    assert set(content["results"]) == set(results) == {"pretrain", "downstream", "sustained"}
    ours = [f"ours {precision}" for precision in precisions()]
    assert list(results["pretrain"]["timings"]) == ["plain fp32", *ours]
    halved = ["ours fp32, dense features in bf16"] if len(ours) == 1 else []
    anew, dense = ([f"{name}, {words}" for name in ours] for words in ("encoding anew", "dense features"))
    both = [*anew, *halved, *dense]
    assert list(results["downstream"]["timings"]) == ["plain fp32", *both]
    for section in ("pretrain", "downstream"):
        assert all(entry["median_s"] > 0 for entry in content["results"][section]["timings"].values())
        assert (
            content["results"][section]["times_slower"][both[-1] if section == "downstream" else ours[-1]]
            == 1
        )
    sustained = content["results"]["sustained"]
    assert sustained["projected_hours"] == pytest.approx(50_000 * sustained["seconds"] / 4 / 3600)
    printed = capsys.readouterr().out
    assert printed.count("\n|---") == 3
    assert "| plain fp32 |" in printed


@pytest.mark.gl
def test_a_decision_on_the_simulator_is_taken_apart_into_its_stages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = main(dataclasses.replace(TINY, only=("agent-step",), out=tmp_path))
    ways = results["agent-step"]["ways"]
    assert [way["is_ahead"] for way in ways] == [False, True]
    for way in ways:
        stages = way["stages"]
        assert all(stages[name] > 0 for name in stages if not name.startswith("rest"))
        whole = sum(seconds for name, seconds in stages.items() if "of it" not in name)
        assert whole == pytest.approx(way["mean_s"])
        parts = sum(seconds for name, seconds in stages.items() if "of it" in name)
        assert parts < stages["update"]
        assert way["projected_hours"] == pytest.approx(way["mean_s"] * 250_000 / 3600)
    assert capsys.readouterr().out.count("| **whole**") == 2


def test_dense_features_that_do_not_fit_the_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    config = library_updates.DownstreamConfig(action_repeat=2, replay_capacity=40_000)
    pretrained = library_updates.fresh_pretrained(image_size=16)
    library_updates.require_dense(pretrained, config)
    monkeypatch.setattr("crptpro.transforms.shift_cache.free_bytes", lambda device: 1_000_000)
    with pytest.raises(CRPTproError, match=r"too little memory .* Ask for fewer transitions"):
        library_updates.require_dense(pretrained, config)


def test_the_timed_pretraining_updates_are_those_of_pretrain(tmp_path: Path) -> None:
    paths = [
        write_dataset(tmp_path / str(seed), transitions=20, seed=seed, image_size=16) for seed in range(2)
    ]
    timed, whole = (fresh_loss(image_size=16, prototypes=16) for _ in range(2))
    assert method_defaults(whole).updates == 50_000
    unit = PretrainUpdates(timed, paths, batch_size=8, precision="fp32")
    for _ in range(3):
        unit()
    pretrain(whole, paths, updates=3, batch_size=8, precision="fp32", progress=False)
    for ours, theirs in zip(timed.parameters(), whole.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_a_directory_that_is_no_released_agent_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(CRPTproError) as error:
        main(dataclasses.replace(TINY, peer=tmp_path))
    assert str(error.value) == (
        f"{tmp_path} has no proto.py, utils.py, replay_buffer.py: --peer wants a checkout of liuxin0824/CRPTpro or "
        "denisyarats/proto."
    )


def test_files_of_another_repository_are_refused_by_name(checkout: Path) -> None:
    (checkout / "proto.py").write_text("import hydra\n")
    with pytest.raises(CRPTproError, match="defines no ProtoAgent"):
        load(checkout)
    (checkout / "proto.py").write_text("import a_package_nobody_has\n")
    with pytest.raises(CRPTproError, match=r"ModuleNotFoundError: .*a_package_nobody_has"):
        load(checkout)


def test_a_peer_imports_without_its_packages_and_leaves_no_trace(checkout: Path) -> None:
    before, path = set(sys.modules), list(sys.path)
    modules = load(checkout)
    assert {"utils", "proto", "replay_buffer"} == set(modules)
    assert not {"utils", "proto", "replay_buffer"} & (set(sys.modules) - before)
    assert sys.path == path
    assert all(name in before for name in ("hydra", "kornia", "gym") if name in sys.modules)


def test_a_peer_updates_from_the_arrays_of_the_plain_store(checkout: Path, tmp_path: Path) -> None:
    store = StackedStore.of(FrameDataset.open(write_dataset(tmp_path / "toy", transitions=6)), 6)
    peer = Peer(checkout, batch_size=4, prototypes=16)
    pretraining, downstream = peer.pretrain_update(store), peer.downstream_update(store)
    assert [pretraining() for _ in range(2)][-1] == [2, 2]
    assert [downstream() for _ in range(3)][-1] == [0, 1, 2]
    small = write_dataset(tmp_path / "small", transitions=6, image_size=16)
    with pytest.raises(CRPTproError, match="takes images of 84 px, not 16"):
        peer.pretrain_update(StackedStore.of(FrameDataset.open(small), 6))


def test_the_stand_in_crop_is_one_integer_crop_per_sample() -> None:
    torch.manual_seed(0)
    images = torch.arange(36.0).view(1, 1, 6, 6).expand(200, 1, 6, 6)
    corners = RandomCrop((4, 4))(images)[:, 0, 0, 0]
    assert corners.unique().tolist() == [0, 1, 2, 6, 7, 8, 12, 13, 14]

"""Which observations stand for which part of a training, where a source does not have them all."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from toy_world import collection_request, random_episode

from crptpro.cards import write_json
from crptpro.data import FrameReplay
from crptpro.data.collection import DomainCollection
from crptpro.experiments.building import JobSettings, build
from crptpro.experiments.goals import encoder
from crptpro.experiments.measurements import CoveragePiece
from crptpro.experiments.pieces import DatasetPiece, ExploredPiece, UntrainedPiece
from crptpro.experiments.row_files import read_rows
from crptpro.experiments.scales import TINY
from crptpro.experiments.store import DONE, Store
from crptpro.pretrained import load_pretrained, save_pretrained

SIZE = 84
EPISODES = 6
LENGTH = 10


def toy_dataset(store: Store, transitions: int) -> DatasetPiece:
    piece = DatasetPiece("pendulum", transitions, 0)
    request = collection_request(domain="pendulum", transitions=transitions, image_size=SIZE)
    collection = DomainCollection(store.dataset(piece), request)
    for index in range(transitions // LENGTH):
        collection.next_job()
        collection.accept(index, random_episode(LENGTH, size=SIZE, seed=index))
    collection.close()
    write_json(store.path(piece) / DONE, {"seconds": 1.0})
    return piece


def lived(store: Store) -> tuple[ExploredPiece, list[torch.Tensor]]:
    """An explorer that has spent 60 decisions and kept the newest; returns every observation that it decided on."""
    piece = encoder(TINY, "proto-rl-c", ("pendulum",), 0)
    assert isinstance(piece, ExploredPiece)
    control = UntrainedPiece("random-encoder", 0)
    build(control, store, JobSettings())
    training = {
        "env_steps": 2 * EPISODES * LENGTH,
        "datasets": [{"domain": "pendulum", "agent_steps": EPISODES * LENGTH, "episodes": EPISODES}],
    }
    artifact = replace(
        load_pretrained(store.encoder(control)), card={"method": "proto-rl-c", "training": training}
    )
    save_pretrained(artifact, store.encoder(piece))
    replay = FrameReplay(
        20, frame_shape=(3, SIZE, SIZE), action_dim=1, path=store.path(piece) / "replay" / "pendulum"
    )
    generator, seen = torch.Generator().manual_seed(0), []
    for _ in range(EPISODES):
        frames = torch.randint(256, (LENGTH + 1, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
        frames = (frames * torch.rand(LENGTH + 1, 1, 1, 1, generator=generator)).to(torch.uint8)
        replay.begin_episode(frames[0])
        for step in range(LENGTH):
            seen.append(torch.cat([frames[max(0, step - age)] for age in (2, 1, 0)]))
            replay.append(torch.zeros(1), 0.0, False, step == LENGTH - 1, frames[step + 1])
    replay.flush()
    write_json(store.path(piece) / DONE, {"seconds": 1.0})
    return piece, seen


def test_a_window_that_a_source_does_not_have_whole_is_left_out_and_the_others_are_exact(
    tmp_path: Path,
) -> None:
    store = Store(tmp_path)
    explorer, seen = lived(store)
    data = toy_dataset(store, 40)
    control = UntrainedPiece("random-encoder", 0)
    piece = CoveragePiece(explorer, (data,), control, samples=15, windows=4)
    build(piece, store, JobSettings())
    rows = read_rows(store.path(piece) / "coverage.csv")
    # 60 decisions are four windows of 15. The dataset has the first 40, the ring (39 frames) about the last 34.
    assert [(row["source"], row["env_steps"], row["samples"]) for row in rows] == [
        ("random", "30", "15"),
        ("random", "60", "15"),
        ("explorer", "90", "15"),
        ("explorer", "120", "15"),
    ]
    network = load_pretrained(store.encoder(control)).encoder
    for row, first in zip(rows[2:], (30, 45)):
        z = F.normalize(network(torch.stack(seen[first : first + 15])), dim=1).double()
        near = torch.cdist(z, z, compute_mode="donot_use_mm_for_euclid_dist").sort(dim=1).values[:, 1:13]
        expected = torch.log(1 + near.mean(1)).mean()
        assert math.isclose(float(row["coverage"]), float(expected), rel_tol=1e-4)

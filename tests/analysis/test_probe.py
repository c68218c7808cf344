from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from toy_world import collection_request, random_episode

from crptpro.analysis.probe import ProbeSamples, probe, probe_embeddings, probe_frame_rows, probe_samples
from crptpro.data import Episode, FrameDataset
from crptpro.data.collection import DomainCollection
from crptpro.errors import DatasetError

SIZE = 6


def shown_episode(index: int, length: int = 12) -> Episode:
    """Its picture shows qpos as brightness, a code of the episode that tells qvel of this episode only."""
    episode = random_episode(length, size=SIZE, seed=index)
    rng = np.random.default_rng(100 + index)
    qpos = np.concatenate([rng.uniform(0, 1, (length + 1, 3)), np.full((length + 1, 1), 2.0)], 1)
    qvel = np.repeat(rng.normal(size=(1, 3)), length + 1, 0) + 0.01 * rng.normal(size=(length + 1, 3))
    pixels = np.zeros_like(episode.pixels)
    pixels[:, :, 0, 0] = np.round(qpos[:, :3] * 255)
    pixels[:, 0].reshape(length + 1, -1)[:, 6 + index] = 255
    values = {name: getattr(episode, name) for name in ("action", "reward", "terminated", "truncated")}
    return Episode(pixels=pixels, state={"qpos": qpos, "qvel": qvel}, **values)


@pytest.fixture
def dataset(tmp_path: Path) -> FrameDataset:
    collection = DomainCollection(tmp_path, collection_request(transitions=144, image_size=SIZE))
    for index in range(12):
        collection.next_job()
        collection.accept(index, shown_episode(index))
    return FrameDataset.open(tmp_path)


class Flatten(nn.Module):
    def forward(self, pixels: Tensor) -> Tensor:
        return pixels.flatten(1).float()


def test_what_a_picture_shows_is_found_and_what_only_marks_an_episode_is_not(dataset: FrameDataset) -> None:
    samples = probe_samples(dataset)
    result = probe(samples, Flatten())["features"]
    assert set(result.positions) == {"qpos[0]", "qpos[1]", "qpos[2]"}
    assert result.left_out == ("position qpos[3]",)
    assert min(result.positions.values()) > 0.99
    # Every training row's velocity could be read off its episode's mark: memorising would give 1.
    assert result.velocity_r2 < 0.1
    mixed = torch.randperm(len(samples.pixels), generator=torch.Generator().manual_seed(0))
    third = len(mixed) // 3
    leaking = ProbeSamples(
        samples.pixels, samples.positions, samples.velocities, samples.position_names, samples.velocity_names,
        mixed[:third], mixed[third : 2 * third], mixed[2 * third :], 0,
    )  # fmt: skip
    assert probe(leaking, Flatten())["features"].velocity_r2 > 0.9


def test_no_episode_is_in_two_parts_and_every_sample_is_in_one(dataset: FrameDataset) -> None:
    samples = probe_samples(dataset, samples=100)
    parts = [samples.train, samples.validation, samples.test]
    assert torch.cat(parts).sort().values.equal(torch.arange(100))
    assert samples.held_out_episodes == 3
    marks = samples.pixels[:, -3].flatten(1)[:, 6:18].argmax(1)
    episodes = [set(marks[part].tolist()) for part in parts]
    assert len(episodes[0] | episodes[1] | episodes[2]) == sum(map(len, episodes))
    assert len(episodes[2]) == 3


def test_the_frames_that_samples_read_are_known_beforehand(dataset: FrameDataset) -> None:
    samples = probe_samples(dataset, samples=50, seed=1)
    rows = probe_frame_rows(dataset, samples=50, seed=1)
    read = samples.pixels.reshape(-1, 3, SIZE, SIZE).unique(dim=0)
    assert dataset.frames_at(rows).unique(dim=0).equal(read)
    assert rows.diff().min() > 0


def test_states_belong_to_the_newest_frame_of_their_stack(dataset: FrameDataset) -> None:
    samples = probe_samples(dataset)
    newest = samples.pixels[:, -3:, 0, 0].double() / 255
    torch.testing.assert_close(newest, samples.positions[:, :3], atol=0.002, rtol=0)
    assert samples.pixels.shape == (144, 9, SIZE, SIZE)


def test_the_same_seed_draws_the_same_samples_in_every_colour(dataset: FrameDataset) -> None:
    first, again, other = (probe_samples(dataset, samples=50, seed=seed) for seed in (0, 0, 1))
    swapped = probe_samples(dataset, samples=50, colors="reversed_image")
    assert first.pixels.equal(again.pixels)
    assert not first.positions.equal(other.positions)
    assert swapped.positions.equal(first.positions)
    assert swapped.test.equal(first.test)
    assert swapped.pixels[:, :3].equal(first.pixels[:, :3].flip(1))


def test_projections_are_probed_beside_the_features(dataset: FrameDataset) -> None:
    blind = nn.Linear(9 * SIZE * SIZE, 4)
    nn.init.zeros_(blind.weight)
    results = probe(probe_samples(dataset), Flatten(), blind)
    assert set(results) == {"features", "z"}
    assert results["z"].position_r2 < 0.05 < results["features"].position_r2
    assert results["z"].mean_cosine == pytest.approx(1)
    assert results["z"].effective_rank == 0


def test_a_coordinate_predicted_worse_than_by_a_constant_counts_as_unknown(dataset: FrameDataset) -> None:
    samples = probe_samples(dataset)
    result = probe_embeddings(samples, torch.randn(144, 30, generator=torch.Generator().manual_seed(0)))
    assert min(result.velocities.values()) < 0
    assert 0 <= result.velocity_r2 < 0.2


def test_where_nothing_varies_there_is_nothing_to_know(dataset: FrameDataset) -> None:
    dataset.frames["qvel"].fill_(3.0)
    result = probe(probe_samples(dataset), Flatten())["features"]
    assert result.velocities == {}
    assert math.isnan(result.velocity_r2)


def test_too_few_episodes_or_samples_are_refused(dataset: FrameDataset) -> None:
    with pytest.raises(DatasetError, match=r"3 samples.*Collect more episodes"):
        probe_samples(dataset, samples=3)


def test_a_dataset_without_physical_state_is_refused(tmp_path: Path) -> None:
    collection = DomainCollection(tmp_path, collection_request(transitions=20, image_size=SIZE))
    for index in range(2):
        collection.next_job()
        collection.accept(index, random_episode(10, state=False))
    with pytest.raises(DatasetError, match="no physical state"):
        probe_samples(FrameDataset.open(tmp_path))

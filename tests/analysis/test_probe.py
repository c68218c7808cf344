"""What frozen features know of the simulator's state, judged on episodes that took no part."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from toy_env import random_episode, write_dataset

from crptpro.analysis.probe import PENALTIES, ProbeResult, ProbeSamples, probe, probe_embeddings, probe_samples
from crptpro.data import FrameDataset

SIZE = 6


def shown_episode(index: int, length: int = 12) -> TensorDict:
    """Its picture shows qpos as brightness, a code of the episode that tells qvel of this episode only."""
    episode = random_episode(length, size=SIZE, seed=index)
    rng = np.random.default_rng(100 + index)
    qpos = np.concatenate([rng.uniform(0, 1, (length + 1, 3)), np.full((length + 1, 1), 2.0)], 1)
    qvel = np.repeat(rng.normal(size=(1, 3)), length + 1, 0) + 0.01 * rng.normal(size=(length + 1, 3))
    pixels = np.zeros((length + 1, 3, SIZE, SIZE), np.uint8)
    pixels[:, :, 0, 0] = np.round(qpos[:, :3] * 255)
    pixels[:, 0].reshape(length + 1, -1)[:, 6 + index] = 255
    for name, values in {"pixels": pixels, "qpos": qpos, "qvel": qvel}.items():
        episode[name], episode["next", name] = torch.from_numpy(values[:-1]), torch.from_numpy(values[1:])
    return episode


@pytest.fixture
def dataset(tmp_path: Path) -> FrameDataset:
    return FrameDataset.open(write_dataset(tmp_path, map(shown_episode, range(12))))


class Flatten(nn.Module):
    def forward(self, pixels: Tensor) -> Tensor:
        return pixels.flatten(1).float()


def test_visible_state_is_predicted_and_a_mark_of_the_episode_is_not(dataset: FrameDataset) -> None:
    samples = probe_samples(dataset)
    result = probe(samples, Flatten())["features"]
    assert set(result.positions) == {"qpos[0]", "qpos[1]", "qpos[2]"}
    assert result.left_out == (("position", "qpos[3]"),)
    assert min(result.positions.values()) > 0.99
    # Every training row's velocity could be read off its episode's mark: memorising would give 1.
    assert result.velocity_r2 < 0.1
    mixed = torch.randperm(len(samples.pixels), generator=torch.Generator().manual_seed(0))
    third = len(mixed) // 3
    leaking = dataclasses.replace(
        samples, train=mixed[:third], validation=mixed[third : 2 * third], test=mixed[2 * third :]
    )
    assert probe(leaking, Flatten())["features"].velocity_r2 > 0.9


def test_the_seed_draws_samples_that_are_split_by_episode_with_the_states_of_the_newest_frame(
    dataset: FrameDataset,
) -> None:
    samples, again, other = (probe_samples(dataset, samples=100, seed=seed) for seed in (0, 0, 1))
    assert samples.pixels.equal(again.pixels)
    assert samples.test.equal(again.test)
    assert not samples.targets.equal(other.targets)
    parts = [samples.train, samples.validation, samples.test]
    assert torch.cat(parts).sort().values.equal(torch.arange(100))
    assert samples.held_out_episodes == 3
    marks = samples.pixels[:, -3].flatten(1)[:, 6:18].argmax(1)
    episodes = [set(marks[part].tolist()) for part in parts]
    assert len(episodes[0] | episodes[1] | episodes[2]) == sum(map(len, episodes))
    assert len(episodes[2]) == 3
    newest = samples.pixels[:, -3:, 0, 0].double() / 255
    torch.testing.assert_close(newest, samples.targets[:, :3], atol=0.002, rtol=0)


def test_projections_are_probed_beside_the_features(dataset: FrameDataset) -> None:
    blind = nn.Linear(9 * SIZE * SIZE, 4)
    nn.init.zeros_(blind.weight)
    results = probe(probe_samples(dataset), Flatten(), blind)
    assert set(results) == {"features", "z"}
    assert results["z"].position_r2 < 0.05 < results["features"].position_r2
    assert results["z"].mean_cosine == pytest.approx(1)
    assert results["z"].effective_rank == 0


def test_a_constant_state_has_no_score(dataset: FrameDataset) -> None:
    dataset.frames["qvel"].fill_(3.0)
    result = probe(probe_samples(dataset), Flatten())["features"]
    assert result.velocities == {}
    assert math.isnan(result.velocity_r2)


ROWS = torch.arange(240)
TRAIN, VALIDATION, TEST = ROWS[:120], ROWS[120:160], ROWS[160:]
FITTED = ROWS[:160]


def fit(features: Tensor, targets: Tensor, **parts: Any) -> ProbeResult:
    names = [("position", f"t{index}") for index in range(targets.shape[1])]
    split = {"train": TRAIN, "validation": VALIDATION, "test": TEST, **parts}
    samples = ProbeSamples(torch.zeros(240), targets.double(), names, held_out_episodes=1, **split)
    return probe_embeddings(samples, features)


def r2(features: Tensor, targets: Tensor) -> Tensor:
    """Of each target, on the last third of 240 rows."""
    return torch.tensor(list(fit(features, targets).positions.values()))


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def test_linear_targets_are_predicted_and_noise_and_memorised_rows_are_not() -> None:
    features = 3 + torch.randn(240, 20) * torch.logspace(-1, 1, 20)
    assert (r2(features, 5 + features @ torch.randn(20, 3)) > 0.9999).all()
    noise = r2(torch.randn(240, 1_000), torch.randn(240, 8))
    assert (noise < 0.05).all()
    assert noise.mean() > -0.3
    assert (r2(torch.eye(240), torch.randn(240, 4)) < 0.05).all()
    constant = r2(torch.ones(240, 7), torch.randn(240, 2))
    assert ((constant <= 0) & (constant > -0.3)).all()


def test_it_is_ridge_regression_with_the_penalty_that_predicts_the_validation_rows_best() -> None:
    features, targets = torch.randn(240, 6).double(), torch.randn(240, 1).double()
    targets += features[:, :1]
    deviation = features[FITTED].std(0, correction=0)
    x = (features - features[FITTED].mean(0)) / (deviation + deviation.square().mean().sqrt())

    def predicted(penalty: float, rows: Tensor, asked: Tensor) -> Tensor:
        own, mean = x[rows] - x[rows].mean(0), targets[rows].mean(0)
        scale = own.square().sum() / len(rows)
        weights = torch.linalg.solve(own.T @ own + penalty * scale * torch.eye(6), own.T @ (targets[rows] - mean))
        return (x[asked] - x[rows].mean(0)) @ weights + mean

    def error(penalty: float) -> float:
        return float((predicted(penalty, TRAIN, VALIDATION) - targets[VALIDATION]).square().sum())

    residual = predicted(min(PENALTIES, key=error), FITTED, TEST) - targets[TEST]
    expected = 1 - residual.square().sum() / (targets[TEST] - targets[TEST].mean(0)).square().sum()
    assert fit(features, targets).position_r2 == pytest.approx(float(expected), abs=1e-8)


def test_held_out_rows_take_no_part_in_standardising_or_choosing() -> None:
    features, targets = torch.randn(240, 300), torch.randn(240, 2)
    targets[:, 0] = features[:, :3].sum(1)
    half = torch.arange(160, 200)
    before = fit(features, targets, test=half).positions
    features[200:] *= 100
    targets[200:] *= 100
    assert fit(features, targets, test=half).positions == before


def test_a_feature_that_marks_single_samples_does_not_drown_the_others() -> None:
    """ReLU features that are active in one sample of hundreds, by the hundreds."""
    rare = torch.zeros(240, 5_000)
    rare[torch.randint(0, 240, (5_000,)), torch.arange(5_000)] = 0.01
    features = torch.cat([torch.randn(240, 5), rare], 1)
    assert r2(features, features[:, :1] + 0.0).item() > 0.98


def test_a_coordinate_predicted_worse_than_by_a_constant_counts_as_unknown() -> None:
    result = fit(torch.randn(240, 30), torch.randn(240, 6))
    assert min(result.positions.values()) < 0
    assert 0 <= result.position_r2 < 0.2


def test_counts_are_taken_as_they_are_meant(dataset: FrameDataset) -> None:
    assert len(probe_samples(dataset, samples=4e1, frame_stack=np.int64(3)).pixels) == 40  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`samples` must be at least 1, got -5"):
        probe_samples(dataset, samples=-5)

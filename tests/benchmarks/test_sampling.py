from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from benchmarks.sampling import Settings, grid_shift, main
from benchmarks.sampling_ways import WAYS
from benchmarks.synthetic import drifting_episode, write_dataset
from stage_here import run_here
from tensordict import TensorDictBase

from benchmarks import sampling
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError, DiskSpaceError
from crptpro.transforms.random_shift import draw_offsets, random_shift

LENGTH, SIZE, TRANSITIONS = 9, 12, 40
KEYS = ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "done"), ("next", "terminated"),
        ("next", "truncated"))  # fmt: skip


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> FrameDataset:
    path = tmp_path_factory.mktemp("benchmark") / "frames"
    write_dataset(path, transitions=TRANSITIONS, image_size=SIZE, episode_transitions=LENGTH)
    return FrameDataset.open(path)


def index_of(dataset: FrameDataset, batch: TensorDictBase) -> torch.Tensor:
    """Where in the dataset the transitions of a batch are."""
    order = dataset.transitions["episode"] * 1000 + dataset.transitions["step"]
    return torch.searchsorted(order, batch["episode"] * 1000 + batch["step"])


@pytest.mark.parametrize("name", WAYS)
def test_every_way_returns_what_ours_has_for_the_same_transitions(name, dataset, tmp_path):
    torch.manual_seed(0)
    way = WAYS[name].build(dataset, 64, tmp_path)
    for _ in range(4):
        batch = way.sample()
        assert batch.batch_size == (64,)
        expected = dataset[index_of(dataset, batch)]
        for key in KEYS:
            assert batch[key].dtype == expected[key].dtype, key
            assert torch.equal(batch[key], expected[key]), key


def test_ours_equals_stacks_made_by_hand(tmp_path):
    write_dataset(tmp_path / "one", transitions=LENGTH, image_size=SIZE, episode_transitions=LENGTH)
    dataset = FrameDataset.open(tmp_path / "one")
    frames = dataset.frames["pixels"]
    padded = torch.cat([frames[:1], frames[:1], frames])
    stacks = torch.stack([padded[t : t + 3].flatten(0, 1) for t in range(LENGTH + 1)])
    assert torch.equal(dataset[:]["pixels"], stacks[:-1])
    assert torch.equal(dataset[:]["next", "pixels"], stacks[1:])


@pytest.mark.parametrize(
    ("name", "first_steps", "last_share"),
    [
        ("ours", {0, 1}, 1 / LENGTH),
        ("stacked-disk", {0, 1}, 1 / LENGTH),
        ("stacked-memory", {0, 1}, 1 / LENGTH),
        ("sequence", {0, 1}, 2 / (LENGTH + 1)),
        ("slices", set(), 1 / (LENGTH - 2)),
        ("catframes", set(), 1 / (LENGTH - 2)),
    ],
)
def test_what_the_table_says_about_the_transitions_that_are_drawn(name, first_steps, last_share, tmp_path):
    path = write_dataset(
        tmp_path / "frames", transitions=10 * LENGTH, image_size=SIZE, episode_transitions=LENGTH
    )
    torch.manual_seed(0)
    way = WAYS[name].build(FrameDataset.open(path), 2_000, tmp_path / "scratch")
    steps = way.sample()["step"]
    assert set(steps.tolist()) & {0, 1} == first_steps
    assert (steps == LENGTH - 1).float().mean().item() == pytest.approx(last_share, abs=0.03)


def test_frames_of_a_drifting_picture_all_differ_and_are_no_flat_colour():
    pixels = drifting_episode(200, seed=1).pixels
    assert len({frame.tobytes() for frame in pixels}) == 201
    assert pixels.std() > 20
    assert abs(pixels[:, :, 1:].astype(int) - pixels[:, :, :-1]).mean() < 15, "neighbouring pixels are alike"


def test_the_shift_by_grid_sample_is_the_exact_shift_up_to_rounding():
    pixels = torch.from_numpy(drifting_episode(15, seed=2).pixels)
    offsets = draw_offsets(16, 4, torch.Generator().manual_seed(0))
    exact = random_shift(pixels, offsets, pad=4)
    torch.testing.assert_close(grid_shift(pixels, offsets), exact.float(), rtol=0, atol=0.01)


def test_the_script_writes_its_results_and_prints_its_tables(tmp_path, capsys):
    settings = Settings(
        transitions=60, batch_size=8, image_size=SIZE, rounds=1, warmup=0, threads=1, scratch=tmp_path,
        out=tmp_path / "results",
    )  # fmt: skip
    results = main(settings, run_stage=run_here)
    written = json.loads((tmp_path / "results" / "sampling.json").read_text())
    assert written["settings"]["transitions"] == 60
    assert set(written["results"]["timings"]) == set(WAYS)
    assert written["results"]["times_slower"]["ours"] == 1
    stored = results["stored_bytes_per_transition"]
    frame = 3 * SIZE**2
    for name, frames in sampling.FRAMES_PER_TRANSITION.items():
        assert frames * frame < stored[name] < frames * frame + 150, name
    printed = capsys.readouterr().out
    assert printed.count("| crptpro `FrameDataset.sample`") == 2
    assert "| the imports alone |" in printed
    assert [file.name for file in tmp_path.iterdir()] == ["results"], "the frames are gone"


def test_an_unknown_way_is_refused():
    with pytest.raises(CRPTproError, match="stacked-disk"):
        main(Settings(ways=("ours", "magic")))


def test_more_than_fits_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    with pytest.raises(DiskSpaceError):
        main(Settings(transitions=10**9, scratch=tmp_path))
    monkeypatch.setattr(sampling, "free_bytes", lambda device: 10**6)
    with pytest.raises(CRPTproError, match="leave stacked-memory out"):
        main(Settings(transitions=100, scratch=tmp_path))
    assert not list(Path(tmp_path).iterdir())

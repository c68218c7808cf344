from __future__ import annotations

from pathlib import Path

import pytest
import torch
from toy_world import FIXED

from crptpro.data import FrameDataset, collect_random
from crptpro.data.redraw import DrawnFrames, redraw
from crptpro.domains import Domain, register_domain
from crptpro.errors import DatasetError

REVERSED = "reversed_background"
SETTINGS = {"image_size": 32, "action_repeat": 200, "quality": "fast", "seed": 7, "progress": False}
ROWS, FRAMES = torch.tensor([2, 5, 9]), torch.arange(3, dtype=torch.uint8).view(3, 1, 1, 1).repeat(1, 3, 4, 4)


def collect(domain: str | Domain, root: Path, transitions: int, colors: str = "normal") -> FrameDataset:
    return FrameDataset.open(
        collect_random(domain, root / colors, transitions=transitions, colors=colors, **SETTINGS)
    )


def test_a_dataset_remembers_its_colours_and_reversed_images_are_the_same_episodes(tmp_path: Path) -> None:
    normal, swapped = (collect(FIXED, tmp_path, 15, colors) for colors in ("normal", "reversed_image"))
    assert (normal.card["colors"], swapped.card["colors"]) == ("normal", "reversed_image")
    rows = torch.tensor([0, 9, 3])
    assert swapped.frames_at(rows).equal(normal.frames_at(rows).flip(-3))
    for dataset in (normal, swapped):
        for colors, expected in (("normal", normal), ("reversed_image", swapped)):
            assert redraw(dataset, rows, colors=colors).equal(expected.frames_at(rows))


@pytest.mark.gl
def test_frames_drawn_again_are_those_that_a_collection_in_these_colours_has(tmp_path: Path) -> None:
    normal, reversed_ = (collect("cartpole", tmp_path, 12, colors) for colors in ("normal", REVERSED))
    rows = torch.tensor([14, 0, 7, 5, 7])  # the last frame of an episode, first ones, one twice
    drawn = redraw(normal, rows, colors=REVERSED)
    assert not drawn.equal(normal.frames_at(rows))
    assert drawn.equal(reversed_.frames_at(rows))
    assert redraw(reversed_, rows, colors="normal").equal(normal.frames_at(rows))
    # What was drawn before is read, and only the others are drawn.
    before = DrawnFrames("cartpole", REVERSED, torch.tensor([5, 7]), torch.full_like(drawn[:2], 9))
    found = redraw(normal, rows, colors=REVERSED, drawn=before)
    assert found[:2].equal(drawn[:2])
    assert (found[2:] == 9).all()
    other = DrawnFrames("walker", REVERSED, before.rows, before.frames)
    with pytest.raises(DatasetError, match="walker in reversed_background were given for cartpole"):
        redraw(normal, rows, colors=REVERSED, drawn=other)
    normal.frames["qpos"].copy_(normal.frames["qpos"] + 0.5)  # mapped privately: the file stays
    with pytest.raises(DatasetError, match=r"cannot be drawn again.*grey levels"):
        redraw(normal, torch.arange(6), colors=REVERSED)


@pytest.mark.gl
def test_what_the_task_draws_at_a_reset_comes_back(tmp_path: Path) -> None:
    """The target of reacher is placed at random and is no part of qpos."""
    normal = collect("reacher", tmp_path, 12)
    drawn = redraw(normal, torch.arange(14), colors=REVERSED)
    assert drawn[:, 1].equal(normal.frames_at(torch.arange(14))[:, 1])  # green keeps its place


def test_worlds_without_a_known_background_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("crptpro.domains._registered", {})
    register_domain(FIXED)
    with pytest.raises(DatasetError, match="dm_control"):
        redraw(collect(FIXED, tmp_path, 5), torch.arange(3), colors=REVERSED)


def test_drawn_frames_are_kept_on_disk_and_found_by_their_rows(tmp_path: Path) -> None:
    path = DrawnFrames("walker", REVERSED, ROWS, FRAMES).save(tmp_path / "frames")
    again = DrawnFrames.load(path)
    assert (again.domain, again.colors) == ("walker", REVERSED)
    assert again.at(torch.tensor([9, 2, 9])).equal(FRAMES[[2, 0, 2]])
    assert again.have(torch.tensor([2, 3, 9])).tolist() == [True, False, True]
    weights = path / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(DatasetError, match=r"weights\.safetensors is not the file its card was written for"):
        DrawnFrames.load(path)
    for rows in ([2, 5], [2, 9, 5], [2, 5, 5]):
        with pytest.raises(ValueError, match="rows"):
            DrawnFrames("walker", REVERSED, torch.tensor(rows), FRAMES)

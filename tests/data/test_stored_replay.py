from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch

from crptpro.data import FrameReplay, StoredReplay
from crptpro.errors import DatasetError

SIZE = 4


def frame(number: int) -> torch.Tensor:
    """A frame that says which one it is."""
    return torch.full((3, SIZE, SIZE), number % 256, dtype=torch.uint8)


def live(path: Path, episodes: list[int], *, capacity: int = 40, slack: int = 0) -> list[list[int]]:
    """Write episodes of so many transitions; returns the frames of every observation that was decided on."""
    replay = FrameReplay(capacity, frame_shape=(3, SIZE, SIZE), action_dim=1, path=path, slack=slack)
    seen, number = [], 0
    for length in episodes:
        replay.begin_episode(frame(number))
        stack = [number] * 3
        for step in range(length):
            seen.append(stack)
            number += 1
            is_last = step == length - 1
            replay.append(torch.zeros(1), 0.0, False, is_last, frame(number))
            stack = [*stack[1:], number]
        number += 1
    replay.flush()
    return seen


def shown(replay: StoredReplay) -> list[list[int]]:
    return replay.observations(torch.arange(len(replay)))[:, ::3, 0, 0].tolist()


def digest(path: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in path.iterdir()}


def test_every_observation_that_was_decided_on_is_there_in_order(tmp_path: Path) -> None:
    seen = live(tmp_path / "r", [3, 5, 1])
    replay = StoredReplay(tmp_path / "r")
    assert len(replay) == 9
    assert shown(replay) == seen
    assert replay.observations(torch.tensor([2])).shape == (1, 9, SIZE, SIZE)


def test_the_last_observation_of_a_running_episode_was_not_decided_on(tmp_path: Path) -> None:
    replay = FrameReplay(10, frame_shape=(3, SIZE, SIZE), action_dim=1, path=tmp_path)
    replay.begin_episode(frame(0))
    replay.append(torch.zeros(1), 0.0, False, False, frame(1))
    replay.flush()
    assert shown(StoredReplay(tmp_path)) == [[0, 0, 0]]


def test_a_ring_that_went_round_holds_the_newest(tmp_path: Path) -> None:
    seen = live(tmp_path / "r", [20, 7, 30, 12], capacity=20, slack=5)
    replay = StoredReplay(tmp_path / "r")
    assert 20 <= len(replay) < 69
    assert shown(replay) == seen[-len(replay) :]


def test_a_longer_stack_is_filled_with_the_first_frame(tmp_path: Path) -> None:
    live(tmp_path / "r", [4])
    replay = StoredReplay(tmp_path / "r", frame_stack=4)
    assert shown(replay) == [[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 2], [0, 1, 2, 3]]


def test_reading_changes_no_file(tmp_path: Path) -> None:
    live(tmp_path / "r", [3, 5], capacity=6)
    before = digest(tmp_path / "r")
    replay = StoredReplay(tmp_path / "r")
    replay.observations(torch.arange(len(replay))).zero_()
    del replay
    assert digest(tmp_path / "r") == before


def test_what_is_no_replay_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"absent holds no replay: number.memmap"):
        StoredReplay(tmp_path / "absent")
    FrameReplay(10, frame_shape=(3, SIZE, SIZE), action_dim=1, path=tmp_path / "new")
    with pytest.raises(DatasetError, match="no transition"):
        StoredReplay(tmp_path / "new")
    live(tmp_path / "cut", [4])
    with open(tmp_path / "cut" / "pixels.memmap", "ab") as file:
        file.write(b"x")
    with pytest.raises(DatasetError, match="square RGB"):
        StoredReplay(tmp_path / "cut")
    live(tmp_path / "torn", [4])
    numbers = torch.from_file(
        str(tmp_path / "torn" / "number.memmap"), shared=True, size=59, dtype=torch.int64
    )
    numbers[2] = 0
    with pytest.raises(DatasetError, match="lost rows"):
        StoredReplay(tmp_path / "torn")

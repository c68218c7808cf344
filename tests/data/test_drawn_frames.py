from __future__ import annotations

from pathlib import Path

import pytest
import torch

from crptpro.data.drawn_frames import DrawnFrames
from crptpro.errors import DatasetError

ROWS = torch.tensor([2, 5, 9])
FRAMES = torch.arange(3, dtype=torch.uint8).view(3, 1, 1, 1).expand(3, 3, 4, 4).contiguous()


def test_frames_are_found_by_their_rows() -> None:
    drawn = DrawnFrames("walker", "reversed_background", ROWS, FRAMES)
    assert drawn.at(torch.tensor([9, 2, 9])).equal(FRAMES[[2, 0, 2]])
    assert drawn.have(torch.tensor([2, 3, 9])).tolist() == [True, False, True]


def test_saved_frames_come_back(tmp_path: Path) -> None:
    drawn = DrawnFrames("walker", "reversed_background", ROWS, FRAMES)
    again = DrawnFrames.load(drawn.save(tmp_path / "frames"))
    assert (again.domain, again.colors) == ("walker", "reversed_background")
    assert again.rows.equal(ROWS)
    assert again.frames.equal(FRAMES)


def test_damaged_frames_are_refused_by_name(tmp_path: Path) -> None:
    path = DrawnFrames("walker", "reversed_background", ROWS, FRAMES).save(tmp_path / "frames")
    weights = path / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(DatasetError, match=r"weights\.safetensors is not the file its card was written for"):
        DrawnFrames.load(path)


@pytest.mark.parametrize("rows", [[2, 5], [2, 9, 5], [2, 5, 5]])
def test_rows_that_could_not_be_found_again_are_refused(rows: list[int]) -> None:
    with pytest.raises(ValueError, match="rows"):
        DrawnFrames("walker", "reversed_background", torch.tensor(rows), FRAMES)

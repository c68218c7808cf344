from __future__ import annotations

import importlib.util
import logging
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from crptpro.training import video
from crptpro.training.video import write_video


@pytest.fixture(autouse=True)
def _fresh_warnings() -> None:
    video._warn_once.cache_clear()


def pictures(count: int = 6) -> torch.Tensor:
    """A grey that brightens from picture to picture."""
    return torch.arange(count, dtype=torch.uint8).mul(40).reshape(-1, 1, 1, 1).expand(-1, 3, 21, 21)


def without_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "imageio_ffmpeg" else find(name)
    )


@pytest.mark.parametrize("is_installed", [importlib.util.find_spec("imageio_ffmpeg") is not None])
def test_a_video_has_every_picture_in_order_or_is_announced_as_missing(
    tmp_path: Path, is_installed: bool, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "videos" / "episode.mp4"
    if not is_installed:
        assert write_video(pictures(), path) is None
        assert "crptpro[video]" in caplog.text
        return
    import imageio.v3 as imageio

    assert write_video(pictures(), path) == path
    assert [file.name for file in path.parent.iterdir()] == ["episode.mp4"]
    read = imageio.imread(path, plugin="FFMPEG")
    assert read.shape == (6, 84, 84, 3)
    assert [round(float(picture.mean()) / 40) for picture in read] == [0, 1, 2, 3, 4, 5]


def test_without_the_extra_there_is_one_warning_and_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    without_encoder(monkeypatch)
    with caplog.at_level(logging.WARNING):
        assert [write_video(pictures(), tmp_path / f"{i}.mp4") for i in range(3)] == [None] * 3
    assert caplog.text.count("pip install 'crptpro[video]'") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_encoder_that_fails_is_a_warning_too_and_leaves_no_torn_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(path: Path, *_: object, **__: object) -> None:
        Path(path).write_bytes(b"half")
        raise OSError("ffmpeg went away")

    writer = SimpleNamespace(mimwrite=fail)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    monkeypatch.setitem(sys.modules, "imageio", SimpleNamespace(v2=writer))
    monkeypatch.setitem(sys.modules, "imageio.v2", writer)
    with caplog.at_level(logging.WARNING):
        assert write_video(pictures(), tmp_path / "episode.mp4") is None
    assert caplog.text.count("ffmpeg went away") == 1
    assert list(tmp_path.iterdir()) == []

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path

import pytest
import torch

from crptpro.errors import CheckpointError, DiskSpaceError
from crptpro.training import checkpoint
from crptpro.training.checkpoint import CheckpointDir


def _state(value: float) -> dict:
    return {"weight": torch.full((3,), value), "nested": {"list": [1, 2.5, "text", None, True], 7: (1, 2)}}


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    checkpoints = CheckpointDir(tmp_path / "checkpoints")
    assert checkpoints.load_latest() is None
    assert checkpoints.latest_counter() is None
    checkpoints.save(_state(1.0), counter=3)
    loaded = checkpoints.load_latest()
    assert checkpoints.latest_counter() == 3
    assert torch.equal(loaded["weight"], torch.ones(3))
    assert loaded["nested"] == _state(1.0)["nested"]


def test_only_the_last_two_are_kept(tmp_path: Path) -> None:
    checkpoints = CheckpointDir(tmp_path, keep_last=2)
    for counter in (1, 2, 30):
        checkpoints.save(_state(counter), counter=counter)
    assert len(list(tmp_path.iterdir())) == 2
    assert checkpoints.load_latest()["weight"][0] == 30


def test_saving_one_counter_again_replaces_it(tmp_path: Path) -> None:
    checkpoints = CheckpointDir(tmp_path)
    checkpoints.save(_state(1.0), counter=5)
    checkpoints.save(_state(2.0), counter=5)
    assert [p.name.split("-")[1] for p in tmp_path.iterdir()] == ["000000000005"]
    assert checkpoints.load_latest()["weight"][0] == 2.0


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty"])
def test_a_damaged_newest_falls_back_to_the_one_before(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    checkpoints = CheckpointDir(tmp_path)
    checkpoints.save(_state(1.0), counter=1)
    newest = checkpoints.save(_state(2.0), counter=2)
    content = bytearray(newest.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 1
    newest.write_bytes({"truncated": content[:-20], "flipped": content, "empty": b""}[damage])
    with caplog.at_level(logging.WARNING):
        assert checkpoints.load_latest()["weight"][0] == 1.0
    assert "damaged" in caplog.text
    assert "counter 2" in caplog.text


def test_a_damaged_future_does_not_outlive_the_next_checkpoint(tmp_path: Path) -> None:
    checkpoints = CheckpointDir(tmp_path)
    checkpoints.save(_state(1.0), counter=10)
    checkpoints.save(_state(2.0), counter=20).write_bytes(b"")
    checkpoints.save(_state(3.0), counter=15)
    assert checkpoints.latest_counter() == 15
    assert len(list(tmp_path.iterdir())) == 2


def test_when_all_are_damaged_the_error_says_so(tmp_path: Path) -> None:
    checkpoints = CheckpointDir(tmp_path)
    checkpoints.save(_state(1.0), counter=1).write_bytes(b"not a checkpoint")
    with pytest.raises(CheckpointError, match="All 1 checkpoints"):
        checkpoints.load_latest()


def test_a_foreign_file_under_a_right_name_is_never_unpickled(tmp_path: Path) -> None:
    import hashlib
    import pickle

    evil = pickle.dumps(os.getcwd)
    name = f"checkpoint-000000000001-{hashlib.sha256(evil).hexdigest()}.pt"
    (tmp_path / name).write_bytes(evil)
    with pytest.raises(CheckpointError, match="damaged"):
        CheckpointDir(tmp_path).load_latest()


def test_an_object_in_the_state_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(
        CheckpointError, match=r"state\['a'\]\[1\] is a Path|state\['a'\]\[1\] is a PosixPath"
    ):
        CheckpointDir(tmp_path / "new").save({"a": [1, Path("x")]}, counter=1)
    assert not (tmp_path / "new").exists()


def test_a_slice_of_a_big_buffer_is_stored_alone(tmp_path: Path) -> None:
    path = CheckpointDir(tmp_path).save({"slice": torch.zeros(1_000_000)[:10]}, counter=1)
    assert path.stat().st_size < 10_000


def test_a_full_disk_is_one_clear_error_and_keeps_the_old_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints = CheckpointDir(tmp_path)
    checkpoints.save(_state(1.0), counter=1)

    class FullDisk(checkpoint._HashingWriter):
        def __init__(self, file: object) -> None:
            super().__init__(self)

            def write(content: object) -> int:
                raise OSError(errno.ENOSPC, "No space left on device")

            self.file = type("File", (), {"write": staticmethod(write)})()

    monkeypatch.setattr(checkpoint, "_HashingWriter", FullDisk)
    with pytest.raises(DiskSpaceError, match="disk is full"):
        checkpoints.save(_state(2.0), counter=2)
    monkeypatch.undo()
    assert [p.name[:23] for p in tmp_path.iterdir()] == ["checkpoint-000000000001"]
    assert checkpoints.load_latest()["weight"][0] == 1.0


def test_a_disk_that_reads_back_other_bytes_is_caught_before_anything_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints = CheckpointDir(tmp_path, keep_last=1)
    checkpoints.save(_state(1.0), counter=1)
    monkeypatch.setattr(checkpoint, "_sha256", lambda path: "0" * 64)
    with pytest.raises(CheckpointError, match="read back"):
        checkpoints.save(_state(2.0), counter=2)
    monkeypatch.undo()
    assert checkpoints.load_latest()["weight"][0] == 1.0


@pytest.mark.parametrize("moment", ["replace", "unlink"])
def test_a_kill_around_the_rename_leaves_a_loadable_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    class Killed(BaseException):
        pass

    def die(*arguments: object, **options: object) -> None:
        raise Killed

    checkpoints = CheckpointDir(tmp_path, keep_last=1)
    checkpoints.save(_state(1.0), counter=1)
    if moment == "replace":
        monkeypatch.setattr(checkpoint.os, "replace", die)
    else:
        monkeypatch.setattr(CheckpointDir, "_rotate", die)
    with pytest.raises(Killed):
        checkpoints.save(_state(2.0), counter=2)
    monkeypatch.undo()
    assert checkpoints.load_latest()["weight"][0] == (1.0 if moment == "replace" else 2.0)
    checkpoints.save(_state(3.0), counter=3)
    assert len(list(tmp_path.iterdir())) == 1


def test_leftovers_of_a_kill_are_ignored_and_removed(tmp_path: Path) -> None:
    checkpoints = CheckpointDir(tmp_path)
    (tmp_path / ".partial-checkpoint-123").write_bytes(b"half")
    assert checkpoints.load_latest() is None
    checkpoints.save(_state(1.0), counter=1)
    assert len(list(tmp_path.iterdir())) == 1

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError
from torch import nn

from crptpro import artifact
from crptpro.artifact import read_artifact, write_artifact
from crptpro.errors import CRPTproError, DiskSpaceError, PretrainedError


def write(path: Path, value: float = 1.0) -> Path:
    layer = nn.Linear(2, 3)
    nn.init.constant_(layer.weight, value)
    return write_artifact(path, {"layer": layer}, card={"task": "walker"}, format_name="test", version=2)


def read(path: Path) -> tuple[dict, dict]:
    return read_artifact(path, format_name="test", version=2, error=PretrainedError)


def test_weights_and_card_round_trip(tmp_path: Path) -> None:
    card, tensors = read(write(tmp_path / "a", 2.5))
    assert card["task"] == "walker"
    assert card["format"] == "test"
    assert set(tensors) == {"layer.weight", "layer.bias"}
    torch.testing.assert_close(tensors["layer.weight"], torch.full((3, 2), 2.5), rtol=0, atol=0)


def test_writing_again_replaces_the_artifact_and_leaves_nothing_else(tmp_path: Path) -> None:
    write(tmp_path / "a", 1.0)
    write(tmp_path / "a", 2.0)
    assert read(tmp_path / "a")[1]["layer.weight"][0, 0] == 2
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_what_is_no_artifact_of_this_kind_is_not_replaced(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    (run_dir / "checkpoints").mkdir(parents=True)
    with pytest.raises(CRPTproError, match="is no 'test'; it is not replaced"):
        write(run_dir)
    assert [path.name for path in run_dir.iterdir()] == ["checkpoints"]
    write_artifact(tmp_path / "a", {}, card={}, format_name="other", version=1)
    with pytest.raises(CRPTproError, match="is no 'test'"):
        write(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    assert read(write(tmp_path / "empty"))[0]["task"] == "walker"


@pytest.mark.parametrize(("step", "error", "kind", "message"), [
    ("crptpro.cards.os.fsync", OSError(errno.ENOSPC, "No space left"), DiskSpaceError, "disk is full: {} cannot"),
    ("crptpro.cards.os.replace", OSError(errno.EDQUOT, "Quota"), DiskSpaceError, "disk is full: {} cannot"),
    ("crptpro.artifact.os.fsync", OSError(errno.EIO, "Input/output error"), OSError, "error: '{}'"),
    ("safetensors.torch.save_file", SafetensorError("I/O error: No space left on device (os error 28)"),
     DiskSpaceError, "disk is full: {} cannot"),
    ("safetensors.torch.save_file", SafetensorError("IoError(Os { code: 122, kind: Other, message: 'x' })"),
     DiskSpaceError, "disk is full: {} cannot"),
    ("safetensors.torch.save_file", SafetensorError("no tensor"), SafetensorError, "no tensor"),
])  # fmt: skip
def test_a_failed_write_keeps_the_old_artifact_and_names_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    step: str,
    error: Exception,
    kind: type[Exception],
    message: str,
) -> None:
    write(tmp_path / "a", 1.0)

    def fail(*args: object) -> None:
        raise error

    monkeypatch.setattr(step, fail)
    with pytest.raises(kind, match=message.format(tmp_path / "a")):
        write(tmp_path / "a", 2.0)
    monkeypatch.undo()
    assert read(tmp_path / "a")[1]["layer.weight"][0, 0] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize(
    ("folder", "given"), [("a", "."), ("a", ""), ("a/sub", ".."), ("a/sub", "../sub/..")]
)
def test_the_directory_that_one_is_in_is_read_like_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, given: str
) -> None:
    write(tmp_path / "a", 1.0)
    (tmp_path / "a" / "sub").mkdir()
    monkeypatch.chdir(tmp_path / folder)
    assert read(Path(given))[1]["layer.weight"][0, 0] == 1


def test_a_root_that_is_no_artifact_is_named() -> None:
    with pytest.raises(PretrainedError, match=r"/card\.json does not exist"):
        read(Path("/"))


@pytest.mark.parametrize(("folder", "given"), [("a", "."), ("a", "../a"), ("a/sub", ".."), ("empty", ".")])
def test_the_directory_that_one_is_in_is_not_replaced_under_ones_feet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, given: str
) -> None:
    write(tmp_path / "a", 1.0)
    for name in ("a/sub", "empty"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / folder)
    with pytest.raises(CRPTproError, match="is the current directory or around it"):
        write(Path(given), 2.0)
    assert read(tmp_path / "a")[1]["layer.weight"][0, 0] == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "empty"]
    # Where the new one is found again, a run that began there may save.
    assert read(write(tmp_path / "a", 2.0))[1]["layer.weight"][0, 0] == 2


def test_a_kill_between_the_two_renames_loses_nothing(tmp_path: Path) -> None:
    write(tmp_path / "a", 1.0)
    (tmp_path / "a").rename(artifact._previous(tmp_path / "a"))
    assert read(tmp_path / "a")[1]["layer.weight"][0, 0] == 1


def test_a_reader_between_the_two_renames_of_a_writer_does_not_disturb_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a", 1.0)
    seen = []
    rename = os.rename

    def rename_and_read(old: Path, new: Path) -> None:
        if new == tmp_path / "a":
            seen.append(read(tmp_path / "a")[1]["layer.weight"][0, 0].item())
        rename(old, new)

    monkeypatch.setattr(artifact.os, "rename", rename_and_read)
    write(tmp_path / "a", 2.0)
    assert seen == [1.0]
    assert read(tmp_path / "a")[1]["layer.weight"][0, 0] == 2
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("moment", ["_sha256", "read_json"])
def test_an_artifact_that_is_replaced_while_it_is_read_is_the_new_one_as_a_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    write(tmp_path / "a", 1.0)
    step = getattr(artifact, moment)

    def step_and_replace(*args: object, **kwargs: object) -> object:
        found = step(*args, **kwargs)
        monkeypatch.setattr(artifact, moment, step)
        write(tmp_path / "a", 2.0)
        return found

    monkeypatch.setattr(artifact, moment, step_and_replace)
    card, tensors = read(tmp_path / "a")
    assert tensors["layer.weight"][0, 0] == 2
    assert card == read(tmp_path / "a")[0]


def test_what_a_killed_writer_left_is_removed_by_the_next_and_a_living_ones_is_not(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    prefix = artifact._temporary_prefix(tmp_path / "a")
    others = artifact._temporary_prefix(tmp_path / "a.b")
    stale = tmp_path / f"{prefix}{dead.pid}-k2j3h4x_"
    kept = [
        tmp_path / f"{prefix}{os.getpid()}-k2j3h4x_",  # a writer at work
        tmp_path / f".a.writing-another-host-{dead.pid}-k2j3h4x_",  # whose processes cannot be asked
        tmp_path / f"{others}{dead.pid}-k2j3h4x_",  # of another artifact
    ]
    for path in (stale, *kept):
        path.mkdir()
        (path / "weights.safetensors").write_text("half")
    write(tmp_path / "a")
    assert not stale.exists()
    assert all(path.exists() for path in kept)


def truncate(path: Path) -> None:
    weights = path / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (shutil.rmtree, "does not exist"),
        (lambda p: (p / "card.json").unlink(), "card.json does not exist"),
        (lambda p: (p / "weights.safetensors").unlink(), "weights.safetensors is missing"),
        (truncate, "truncated, damaged or replaced"),
    ],
)
def test_each_kind_of_damage_is_named(tmp_path: Path, damage, message: str) -> None:
    write(tmp_path / "a")
    damage(tmp_path / "a")
    with pytest.raises(PretrainedError, match=message):
        read(tmp_path / "a")


def test_an_artifact_of_another_kind_or_a_newer_version_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a")
    with pytest.raises(PretrainedError, match="is a 'test', expected 'agent'"):
        read_artifact(tmp_path / "a", format_name="agent", version=2, error=PretrainedError)
    with pytest.raises(PretrainedError, match="format version 2; this crptpro reads up to 1"):
        read_artifact(tmp_path / "a", format_name="test", version=1, error=PretrainedError)

"""Files and directories that are whole or not there, and are checked before use."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from crptpro import artifact
from crptpro.artifact import read_artifact, read_json, require_disk, write_artifact, write_json, write_whole
from crptpro.errors import CRPTproError, DiskSpaceError, PretrainedError


def write(path: Path, value: float = 1.0, **card: Any) -> Path:
    layer = nn.Linear(2, 3)
    nn.init.constant_(layer.weight, value)
    card = {"task": "walker", **card}
    return write_artifact(path, {"layer": layer}, card=card, format_name="test", version=2)


def read(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    return read_artifact(path, format_name="test", version=2, error=PretrainedError)


def value_of(path: Path) -> float:
    return float(read(path)[1]["layer.weight"][0, 0])


@pytest.mark.parametrize(("step", "number", "kind", "message"), [
    ("fsync", errno.ENOSPC, DiskSpaceError, "disk is full: {} cannot be written"),
    ("replace", errno.EDQUOT, DiskSpaceError, "disk is full: {} cannot be written"),
    ("rename", errno.EIO, OSError, "Input/output error: '{}'"),
])  # fmt: skip
def test_a_write_that_fails_names_what_it_writes_and_keeps_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, number: int, kind: type[Exception], message: str
) -> None:
    card = tmp_path / "card.json"
    write_json(card, {"a": 1})
    write(tmp_path / "a", 1.0)

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))  # of an open file, the system says no name

    with monkeypatch.context() as patched:
        patched.setattr(artifact.os, step, fail)
        with pytest.raises(kind, match=message.format(tmp_path / "a")):
            write(tmp_path / "a", 2.0)
        if step != "rename":  # a single file is written without it
            with pytest.raises(kind, match=message.format(card)):
                write_json(card, {"a": 2})
    assert read_json(card) == {"a": 1}
    assert value_of(tmp_path / "a") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"a", "card.json"}


def test_every_number_in_a_card_is_the_plain_number_it_means_or_refused_by_name(tmp_path: Path) -> None:
    given = {"size": np.int64(84), "rate": torch.tensor(0.5), "shape": (np.uint8(3), 2), "out": Path("a"), "no": None}
    given["scale"] = np.longdouble(0.5)
    write_json(tmp_path / "card.json", {"config": given, "ok": np.bool_(True)})
    assert read_json(tmp_path / "card.json") == {
        "config": {"size": 84, "rate": 0.5, "shape": [3, 2], "out": "a", "no": None, "scale": 0.5}, "ok": True,
    }  # fmt: skip
    for entry in (object(), nn.Linear(1, 1), 1j, {3: 4}, np.datetime64("2026-01-01")):
        with pytest.raises(ValueError, match=r"card\.json\.config\.what"):
            write_json(tmp_path / "card.json", {"config": {"what": entry}})
    assert read_json(tmp_path / "card.json")["ok"] is True


def test_a_disk_that_cannot_hold_the_data_is_refused_with_both_sizes(tmp_path: Path) -> None:
    with pytest.raises(DiskSpaceError, match=r"collection needs .* GB, but .* has .* GB free"):
        require_disk(tmp_path / "not" / "yet", 10**18, "collection")
    require_disk(tmp_path / "not" / "yet", 1, "collection")


def test_paths_mean_what_a_shell_means(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "home"
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(tmp_path)
    write(Path("~/runs/a"), 3.0)
    assert value_of(home / "runs" / "a") == value_of(Path("~/runs/a")) == 3
    write_json("~/card.json", {"a": 1})
    assert read_json(home / "card.json") == read_json("~/card.json") == {"a": 1}
    assert not Path("~").exists()


@pytest.mark.parametrize("mask", [0o027, 0o077, 0o002])
def test_files_and_directories_have_the_rights_that_the_umask_leaves(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        path = write(tmp_path / "new" / "a")
    finally:
        os.umask(before)
    assert {folder.stat().st_mode & 0o777 for folder in (path.parent, path)} == {0o777 & ~mask}
    assert {file.stat().st_mode & 0o777 for file in path.iterdir()} == {0o666 & ~mask}


def test_what_is_of_another_kind_is_neither_replaced_nor_read(tmp_path: Path) -> None:
    run_dir, other = tmp_path / "run", tmp_path / "a"
    (run_dir / "checkpoints").mkdir(parents=True)
    write_artifact(other, {}, card={}, format_name="other", version=1)
    for path in (run_dir, other):
        with pytest.raises(CRPTproError, match="is not a 'test', so it was left unchanged"):
            write(path)
    assert [path.name for path in run_dir.iterdir()] == ["checkpoints"]
    with pytest.raises(PretrainedError, match="is a 'other', expected 'test'"):
        read(other)
    (tmp_path / "empty").mkdir()
    assert read(write(tmp_path / "empty"))[0]["task"] == "walker"
    (tmp_path / "empty" / "run").mkdir()  # what lies beside an artifact would be lost
    with pytest.raises(CRPTproError, match="holds run beside the 'test' that would be replaced, so it was left unch"):
        write(tmp_path / "empty")
    assert (tmp_path / "empty" / "run").is_dir()


def test_what_was_written_is_read_back_before_it_replaces_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a", 1.0)
    whole = artifact.write_whole

    def lossy(path: Path, content: Any) -> Path:
        return whole(path, content[:-1] if path.name == "weights.safetensors" else content)

    with monkeypatch.context() as patched:
        patched.setattr(artifact, "write_whole", lossy)
        with pytest.raises(CRPTproError, match="truncated, damaged or replaced"):
            write(tmp_path / "a", 2.0)
    assert value_of(tmp_path / "a") == 1


def test_the_directory_that_one_is_in_is_read_but_never_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a", 1.0)
    (tmp_path / "a" / "sub").mkdir()
    monkeypatch.chdir(tmp_path / "a" / "sub")
    assert value_of(Path("..")) == 1
    monkeypatch.chdir(tmp_path / "a")
    for path in (Path("."), tmp_path / "a"):
        with pytest.raises(CRPTproError, match="a is the working directory, which is not replaced"):
            write(path, 2.0)
        assert value_of(path) == 1


def test_after_a_kill_between_the_two_renames_the_same_write_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a", 1.0)
    rename = os.rename

    def killed(old: Path, new: Path) -> None:
        if new == tmp_path / "a":
            raise KeyboardInterrupt
        rename(old, new)

    with monkeypatch.context() as patched:
        patched.setattr(artifact.os, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            write(tmp_path / "a", 2.0)
    assert value_of(tmp_path / ".a.previous") == 1
    write(tmp_path / "a", 2.0)
    assert value_of(tmp_path / "a") == 2


def test_a_second_rename_that_fails_leaves_the_old_artifact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a", 1.0)
    rename = os.rename

    def refused(old: Path, new: Path) -> None:
        if "writing" in Path(old).name:
            raise OSError(errno.EIO, "the disk is gone")
        rename(old, new)

    with monkeypatch.context() as patched:
        patched.setattr(artifact.os, "rename", refused)
        with pytest.raises(OSError, match="the disk is gone"):
            write(tmp_path / "a", 2.0)
    assert value_of(tmp_path / "a") == 1
    assert [each.name for each in tmp_path.iterdir()] == ["a"]


def test_threads_that_write_one_file_leave_a_whole_one(tmp_path: Path) -> None:
    path, contents = tmp_path / "a.txt", [str(digit) * 100_000 for digit in range(4)]

    def repeat(content: str) -> None:
        for _ in range(20):
            write_whole(path, content)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(repeat, contents))
    assert path.read_text() in contents
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(("damage", "message"), [
    (shutil.rmtree, "does not exist"),
    (lambda p: (p / "card.json").unlink(), r"has no card\.json: it is not an artifact"),
    (lambda p: (p / "card.json").write_text("{"), r"card\.json cannot be read as JSON"),
    (lambda p: (p / "card.json").write_text("[1]"), r"card\.json holds a list"),
    (lambda p: (p / "weights.safetensors").unlink(), r"weights\.safetensors is missing"),
    (lambda p: os.truncate(p / "weights.safetensors", 90), "truncated, damaged or replaced"),
    (lambda p: (p / "weights.safetensors").write_bytes(bytes(200)), "truncated, damaged or replaced"),
    (lambda p: write_artifact(p, {}, card={}, format_name="test", version=3), "format version 3; this release reads 2"),
])  # fmt: skip
def test_what_is_damaged_or_too_new_is_named(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    write(tmp_path / "a")
    damage(tmp_path / "a")
    with pytest.raises(PretrainedError, match=message):
        read(tmp_path / "a")

from __future__ import annotations

import errno
import json
import os
import subprocess
from pathlib import Path

import pytest

from crptpro import cards
from crptpro.errors import DatasetError, DiskSpaceError


def test_provenance_names_every_package_that_can_change_a_number() -> None:
    content = cards.provenance()
    assert {"torch", "torchrl", "tensordict", "dm-control", "mujoco", "crptpro", "python"} <= set(
        content["versions"]
    )
    assert "not installed" not in [content["versions"][p] for p in ("torch", "torchrl", "crptpro")]
    assert content["hardware"]["ram_bytes"] > 0
    json.dumps(content)


def test_a_gpu_with_a_broken_driver_is_recorded_and_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def name(index: int) -> str:
        if index == 1:
            raise RuntimeError("CUDA driver version is insufficient\nfor the runtime")
        return "Some GPU"

    monkeypatch.setattr(cards.torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(cards.torch.cuda, "get_device_name", name)
    found = cards.hardware.__wrapped__()
    assert found["gpus"] == ["Some GPU", "unusable: CUDA driver version is insufficient"]


@pytest.mark.parametrize(
    ("bf16", "amx", "named"),
    [
        (False, False, "AVX512"),
        (True, False, "AVX512, AVX512-BF16"),
        (True, True, "AVX512, AVX512-BF16, AMX"),
    ],
)
def test_processors_of_one_name_are_told_apart_by_what_torch_computes_with(
    monkeypatch: pytest.MonkeyPatch, bf16: bool, amx: bool, named: str
) -> None:
    monkeypatch.setattr(cards.torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(cards.torch.cpu, "_is_avx512_bf16_supported", lambda: bf16)
    monkeypatch.setattr(cards.torch.cpu, "_is_amx_tile_supported", lambda: amx)
    assert cards.hardware.__wrapped__()["cpu_instructions"] == named


@pytest.mark.parametrize("is_tracked", [True, False])
def test_only_a_repository_that_tracks_this_package_names_its_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_tracked: bool
) -> None:
    package = tmp_path / ".venv" / "crptpro"
    package.mkdir(parents=True)
    (package / "cards.py").write_text("")
    (tmp_path / "thesis.tex").write_text("x")
    if not is_tracked:
        (tmp_path / ".gitignore").write_text(".venv\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e@example.org"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "begin"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(cards, "__file__", str(package / "cards.py"))
    assert (cards.git_revision.__wrapped__() != "unknown") is is_tracked


def test_json_round_trips_and_leaves_no_temporary_file(tmp_path: Path) -> None:
    cards.write_json(tmp_path / "sub" / "card.json", {"b": 1, "a": [1, 2]})
    assert cards.read_json(tmp_path / "sub" / "card.json") == {"a": [1, 2], "b": 1}
    assert [p.name for p in (tmp_path / "sub").iterdir()] == ["card.json"]


@pytest.mark.parametrize(("number", "kind", "message"), [
    (errno.ENOSPC, DiskSpaceError, r"disk is full: .*/card\.json cannot be written"),
    (errno.EDQUOT, DiskSpaceError, r"disk is full: .*/card\.json cannot be written"),
    (errno.EIO, OSError, r"Input/output error: '.*/card\.json'"),
])  # fmt: skip
def test_a_write_that_fails_names_the_card_and_keeps_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[Exception], message: str
) -> None:
    path = tmp_path / "card.json"
    cards.write_json(path, {"a": 1})

    def fail(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))  # of an open file, the system says no name

    monkeypatch.setattr(cards.os, "fsync", fail)
    with pytest.raises(kind, match=message):
        cards.write_json(path, {"a": 2})
    assert cards.read_json(path) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["card.json"]


@pytest.mark.parametrize(("text", "message"), [("{", "cannot be read as JSON"), ("[1]", "holds a list")])
def test_a_damaged_card_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "card.json").write_text(text)
    with pytest.raises(DatasetError, match=message):
        cards.read_json(tmp_path / "card.json", error=DatasetError)


def test_a_missing_card_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"card\.json does not exist"):
        cards.read_json(tmp_path / "card.json", error=DatasetError)


def test_a_disk_that_cannot_hold_the_data_is_refused_with_both_sizes(tmp_path: Path) -> None:
    with pytest.raises(DiskSpaceError, match=r"collection needs .* GB, but .* has .* GB free"):
        cards.require_disk(tmp_path / "not" / "yet", 10**18, "collection")
    cards.require_disk(tmp_path / "not" / "yet", 1, "collection")

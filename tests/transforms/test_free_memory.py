"""What a container or a batch job may still take, from files like those of Linux."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest
import torch

from crptpro.transforms import free_memory
from crptpro.transforms.free_memory import cgroup_free_bytes, free_bytes


def group(directory: Path, **files: object) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (directory / name.replace("__", ".")).write_text(f"{content}\n")


def left(tmp_path: Path, own: str) -> list[int]:
    (tmp_path / "own").write_text(own)
    return sorted(cgroup_free_bytes(tmp_path / "own", tmp_path / "root"))


def test_the_second_version_counts_the_groups_own_limit_and_those_around_it(tmp_path: Path) -> None:
    root = tmp_path / "root"
    group(root / "job/step", memory__max="max", memory__current=500)
    group(root / "job", memory__max=1000, memory__current=600)
    group(root, memory__max=5000, memory__current=700)
    assert left(tmp_path, "0::/job/step\n") == [400, 4300]


def test_the_first_version_counts_too(tmp_path: Path) -> None:
    usage = {"memory__limit_in_bytes": 900, "memory__usage_in_bytes": 200}
    group(tmp_path / "root/memory/slurm/job", **usage)
    assert left(tmp_path, "5:cpu,cpuacct:/slurm/job\n4:memory:/slurm/job\n1:name=systemd:/\n") == [700]


def test_file_cache_that_can_be_given_back_is_free(tmp_path: Path) -> None:
    limits = {"memory__max": 1000, "memory__current": 950}
    group(tmp_path / "root", **limits, memory__stat="anon 500\ninactive_file 300\nfile 350")
    assert left(tmp_path, "0::/\n") == [350]


def test_a_group_beyond_its_limit_has_nothing_left(tmp_path: Path) -> None:
    group(tmp_path / "root", memory__max=1000, memory__current=1200)
    assert left(tmp_path, "0::/\n") == [0]


@pytest.mark.parametrize("limit", ["max", "", "a lot"])
def test_what_cannot_be_read_sets_no_limit(tmp_path: Path, limit: str) -> None:
    group(tmp_path / "root", memory__max=limit, memory__current=1)
    assert left(tmp_path, "0::/\n") == []
    assert list(cgroup_free_bytes(tmp_path / "missing", tmp_path / "root")) == []


def test_free_memory_is_the_least_of_machine_and_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    available = psutil.virtual_memory().available
    monkeypatch.setattr(free_memory, "cgroup_free_bytes", lambda: iter([2 * available, 1234]))
    assert free_bytes(torch.device("cpu")) == 1234
    monkeypatch.setattr(free_memory, "cgroup_free_bytes", lambda: iter([]))
    assert free_bytes(torch.device("cpu")) > 1234

from __future__ import annotations

from pathlib import Path

import psutil
import pytest
import torch

from crptpro import free_memory
from crptpro.free_memory import cgroup_free_bytes, free_bytes


def v2(limit: object, used: int, **more: object) -> dict[str, object]:
    return {"memory.max": limit, "memory.current": used, **{k.replace("__", "."): v for k, v in more.items()}}


@pytest.mark.parametrize(
    ("own", "groups", "left"),
    [
        # The second version counts the group's own limit and those around it.
        ("0::/job/step\n", {"job/step": v2("max", 500), "job": v2(1000, 600), "": v2(5000, 700)}, [400, 4300]),
        # The first version counts too.
        (
            "5:cpu,cpuacct:/slurm/job\n4:memory:/slurm/job\n1:name=systemd:/\n",
            {"memory/slurm/job": {"memory.limit_in_bytes": 900, "memory.usage_in_bytes": 200}},
            [700],
        ),
        # File cache that can be given back is free.
        ("0::/\n", {"": v2(1000, 950, memory__stat="anon 500\ninactive_file 300\nfile 350")}, [350]),
        # A group beyond its limit has nothing left; what cannot be read sets none.
        ("0::/\n", {"": v2(1000, 1200)}, [0]),
        ("0::/\n", {"": v2("max", 1)}, []),
        ("0::/\n", {"": v2("a lot", 1)}, []),
    ],
)
def test_what_the_cgroups_leave(tmp_path: Path, own: str, groups: dict[str, dict], left: list[int]) -> None:
    (tmp_path / "own").write_text(own)
    for group, files in groups.items():
        directory = tmp_path / "root" / group
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (directory / name).write_text(f"{content}\n")
    assert sorted(cgroup_free_bytes(tmp_path / "own", tmp_path / "root")) == left
    assert list(cgroup_free_bytes(tmp_path / "missing", tmp_path / "root")) == []


def test_free_memory_is_the_least_of_machine_and_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    available = psutil.virtual_memory().available
    monkeypatch.setattr(free_memory, "cgroup_free_bytes", lambda: iter([2 * available, 1234]))
    assert free_bytes(torch.device("cpu")) == 1234
    monkeypatch.setattr(free_memory, "cgroup_free_bytes", lambda: iter([]))
    assert free_bytes(torch.device("cpu")) > 1234
    monkeypatch.setenv("CRPTPRO_JOB_BYTES", "1000")  # of a job that shares the machine with others
    assert free_bytes(torch.device("cpu")) == 1000
    monkeypatch.setenv("CRPTPRO_JOBS_PER_GPU", "2")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (7_000, 8_000))
    assert free_bytes(torch.device("cuda")) == 4_000

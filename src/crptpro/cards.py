"""JSON cards: what made an artifact, written whole or not at all, and checked before use."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import psutil
import torch

from crptpro.errors import CRPTproError, DiskSpaceError
from crptpro.whole_file import write_whole

PACKAGES = (
    "crptpro", "torch", "torchrl", "tensordict", "dm-control", "mujoco", "gymnasium", "numpy", "wandb",
)  # fmt: skip

#: How the name of a GPU begins that torch sees and cannot use.
UNUSABLE = "unusable"


@cache
def versions() -> dict[str, str]:
    """Return the installed version of every package that can change a number, and Python's."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


@cache
def hardware() -> dict[str, Any]:
    """Return what decides how long work takes here.

    Returns:
        ``cpu``, the model; ``cpu_instructions``, see :func:`cpu_instructions`; ``cpu_cores``, that this process may
        use; ``ram_bytes``; ``gpus``, the names torch sees (or why it cannot use one).
    """
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        cpu = names[0].split(":", 1)[1].strip() if names else cpu
    return {
        "cpu": cpu,
        "cpu_instructions": cpu_instructions(),
        "cpu_cores": cpu_cores(),
        "ram_bytes": psutil.virtual_memory().total,
        "gpus": [_gpu_name(index) for index in range(torch.cuda.device_count())],
    }


def cpu_instructions() -> str:
    """Return the vector instructions that torch computes with, e.g. ``"AVX512, AVX512-BF16"``.

    Virtual machines hide the model: two of one name may differ threefold in speed, and one of them multiply no
    bfloat16.
    """
    probes = {"_is_avx512_bf16_supported": "AVX512-BF16", "_is_amx_tile_supported": "AMX"}
    there = [name for probe, name in probes.items() if getattr(torch.cpu, probe, lambda: False)()]
    return ", ".join([torch.backends.cpu.get_cpu_capability(), *there])


def cpu_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpu_name(index: int) -> str:
    try:
        return torch.cuda.get_device_name(index)
    except Exception as reason:  # a driver that is broken, or older than torch wants
        return f"{UNUSABLE}: {(str(reason).splitlines() or [type(reason).__name__])[0]}"


@cache
def git_revision() -> str:
    """Return the revision of the source checkout, ``+dirty`` if modified, or ``"unknown"``."""
    here = Path(__file__).resolve()
    git = ["git", "-C", str(here.parent)]
    # Installed below somebody's repository (a .venv that it ignores), this file is not part of it.
    is_tracked = [*git, "ls-files", "--error-unmatch", here.name]
    describe = [*git, "describe", "--always", "--dirty=+dirty", "--abbrev=12"]
    try:
        for command in (is_tracked, describe):
            answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        return answer.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def provenance() -> dict[str, Any]:
    """Return the part of a card that every artifact shares: versions, hardware, git revision."""
    return {"versions": versions(), "hardware": hardware(), "git_revision": git_revision()}


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Write JSON beside ``path`` and rename it into place, so that a reader never sees half a card.

    Raises:
        DiskSpaceError: if the disk is full; what was there before is kept.
    """
    write_whole(path, json.dumps(content, indent=2, sort_keys=True, default=str) + "\n")


def read_json(path: str | Path, *, error: type[CRPTproError] = CRPTproError) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        CRPTproError: (or ``error``) if the file is missing, not JSON, or not an object.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise error(f"{path} does not exist.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as reason:
        raise error(f"{path} cannot be read as JSON ({reason}); it is damaged or foreign.") from None
    if not isinstance(content, dict):
        raise error(f"{path} holds a {type(content).__name__}, expected a JSON object.")
    return content


def require_disk(path: str | Path, needed_bytes: int, what: str) -> None:
    """Refuse, before anything is written, what the disk under ``path`` cannot hold with 5 % to spare.

    Raises:
        DiskSpaceError: naming what is needed, what is free, and where.
    """
    probe = Path(path).absolute()
    while not probe.exists():
        probe = probe.parent
    free = shutil.disk_usage(probe).free
    if needed_bytes * 1.05 > free:
        raise DiskSpaceError(
            f"{what} needs {needed_bytes / 1e9:.2f} GB, but {probe} has {free / 1e9:.2f} GB free. "
            "Free space, choose another directory, or ask for fewer transitions."
        )

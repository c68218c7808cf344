"""Versions, hardware and source revision, for cards and records."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import psutil
import torch

logger = logging.getLogger(__name__)

UNUSABLE = "unusable"
"""Prefix of the name of a GPU that torch sees and cannot use."""


@cache
def versions() -> dict[str, str]:
    """Return the installed version of every package that can change a number, and Python's."""
    found = {"python": platform.python_version()}
    packages = ("crptpro", "torch", "torchrl", "tensordict", "dm-control", "mujoco", "gymnasium", "numpy", "wandb")
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


@cache
def hardware() -> dict[str, Any]:
    """Return the hardware, which determines run times.

    ``cpu_instructions`` are those that torch uses: virtual processors of one model may differ threefold in speed.
    ``gpus`` are names, or why torch cannot use one.
    """
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"^model name\s*: (.*)", cpuinfo.read_text() if cpuinfo.exists() else "", re.MULTILINE)
    probes = {"_is_avx512_bf16_supported": "AVX512-BF16", "_is_amx_tile_supported": "AMX"}
    present = [name for probe, name in probes.items() if getattr(torch.cpu, probe, lambda: False)()]
    return {
        "cpu": model[1].strip() if model else platform.processor() or platform.machine(),
        "cpu_instructions": ", ".join([torch.backends.cpu.get_cpu_capability(), *present]),
        "cpu_cores": cpu_cores(),
        "ram_bytes": psutil.virtual_memory().total,
        "gpus": [_gpu_name(index) for index in range(torch.cuda.device_count())],
    }


def cpu_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpu_name(index: int) -> str:
    try:
        return torch.cuda.get_device_name(index)
    except Exception as reason:  # a driver that is broken, or older than torch requires
        return f"{UNUSABLE}: {(str(reason).splitlines() or [type(reason).__name__])[0]}"


@cache
def git_revision() -> str:
    """Return the revision of the source checkout, ``+dirty`` if modified, or ``"unknown"``."""
    here = Path(__file__).resolve()
    git = ["git", "-C", str(here.parent)]
    # In a repository's ignored .venv, this file is not part of the repository.
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


def warn_of_other_versions(made_with: Mapping[str, Any], what: str) -> None:
    """Log a warning if a run or dataset is continued with other versions than those it was begun or continued with."""
    before = made_with["versions"]
    changed = [f"{name} {old} is now {now}" for name, now in versions().items() if (old := before.get(name)) != now]
    if changed:
        logger.warning(
            "%s is continued with other versions, which may change its numbers: %s.", what, ", ".join(changed)
        )

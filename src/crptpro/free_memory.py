"""The memory that is free for this process, also in a container or a batch job."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import psutil
import torch

# Version 2, then version 1: the limit, the memory in use, and the reclaimable file cache.
_FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


# Environment variables of jobs that share a machine. A job's dense maps grow while it runs, so that another job may
# need the memory that is free at its start.
JOB_BYTES, JOBS_PER_GPU = "CRPTPRO_JOB_BYTES", "CRPTPRO_JOBS_PER_GPU"


def free_bytes(device: torch.device) -> int:
    """Return the free memory of a device in bytes, at most what the process's cgroups allow, or the job's share."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return min(free, total // int(os.environ.get(JOBS_PER_GPU, 1)))
    share = [int(os.environ[JOB_BYTES])] if JOB_BYTES in os.environ else []
    return min([int(psutil.virtual_memory().available), *cgroup_free_bytes(), *share])


def cgroup_free_bytes(own: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> Iterator[int]:
    """Yield the free bytes of each memory-limited cgroup around this process, which psutil ignores.

    ``own`` lists the groups of the process as ``number:controllers:path``; they are mounted at ``root``.
    """
    for line in own.read_text().splitlines() if own.exists() else []:
        _, controllers, group = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        base = root / "memory" if controllers else root
        innermost = base / group.lstrip("/")
        around = [parent for parent in innermost.parents if parent.is_relative_to(base)]
        for directory in (innermost, *around):
            for limit, usage, cache in _FILES:
                try:
                    left = int((directory / limit).read_text()) - int((directory / usage).read_text())
                except (OSError, ValueError):  # "max" for no limit
                    continue
                statistics = directory / "memory.stat"
                found = re.search(rf"^{cache} (\d+)$", statistics.read_text(), re.M) if statistics.exists() else None
                yield max(0, left + int(found[1] if found else 0))

"""How much memory a process may still take: the machine's, or less inside a container or a batch job."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psutil
import torch

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUPS = Path("/proc/self/cgroup")

# Version 2, then version 1: the limit, what is in use, and the file cache that would be given back first.
_FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


def free_bytes(device: torch.device) -> int:
    """Return the free memory of a device in bytes; on the CPU at most what the process's cgroups allow."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return min([int(psutil.virtual_memory().available), *cgroup_free_bytes()])


def cgroup_free_bytes(own: Path = OWN_CGROUPS, root: Path = CGROUPS) -> Iterator[int]:
    """Yield what each memory-limited cgroup around this process has left, in bytes; what is unreadable counts not.

    Linux counts against the group of a process and all groups around it, in either version of the interface.
    psutil does not look at them: inside a container it reports the machine.

    Args:
        own: the process's groups, one ``number:controllers:path`` a line.
        root: where the groups are mounted.
    """
    for directory in _cgroup_directories(own, root):
        for limit_file, usage_file, cache in _FILES:
            try:
                limit = int((directory / limit_file).read_text())  # "max" for no limit
                usage = int((directory / usage_file).read_text())
            except (OSError, ValueError):
                continue
            yield max(0, limit - usage + _statistic(directory / "memory.stat", cache))


def _cgroup_directories(own: Path, root: Path) -> Iterator[Path]:
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, group = line.split(":", 2)
        if controllers == "" or "memory" in controllers.split(","):
            base = root if controllers == "" else root / "memory"
            innermost = base / group.lstrip("/")
            yield innermost
            yield from (parent for parent in innermost.parents if parent.is_relative_to(base))


def _statistic(path: Path, name: str) -> int:
    try:
        pairs = (line.split() for line in path.read_text().splitlines())
        return next((int(value) for key, value in pairs if key == name), 0)
    except (OSError, ValueError):
        return 0

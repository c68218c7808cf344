"""Memory of a process and its children while it runs, watched from outside (Linux: ``/proc``)."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from crptpro.errors import CRPTproError

#: Seconds between two looks. A look at three processes takes about 0.1 ms.
LOOK_S = 0.02
#: Seconds between two searches for new children, which go through every process of the machine.
SEARCH_S = 0.5

_REPOSITORY = Path(__file__).parent.parent


@dataclass(frozen=True)
class Resident:
    """What a program took.

    Args:
        peak_bytes: Largest sum over the program's processes of resident memory beyond the page cache: anonymous
            and shared memory (``RssAnon`` and ``RssShmem``), which nothing but the program's end gives back.
        peak_file_bytes: Largest sum of the rest, pages of mapped files (``RssFile``): libraries, frames on disk.
        wall_s: How long it ran.
        answer: JSON object of the last line it printed; empty if that is none.
    """

    peak_bytes: int
    peak_file_bytes: int
    wall_s: float
    answer: Mapping[str, Any]


def watch(command: Sequence[str]) -> Resident:
    """Run a program to its end, looking at its memory and its children's every 20 ms.

    Its standard error goes where ours goes.

    Args:
        command: Program and arguments; it runs in the repository's root.

    Raises:
        CRPTproError: if it fails.
    """
    start = time.monotonic()
    with tempfile.TemporaryFile("w+") as printed:
        process = subprocess.Popen(command, stdout=printed, cwd=_REPOSITORY)
        try:
            peak, peak_file = _watch(process)
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
        printed.seek(0)
        output = printed.read()
    if process.returncode:
        raise CRPTproError(
            f"{' '.join(command)} ended with status {process.returncode}; see its messages above."
        )
    return Resident(peak, peak_file, time.monotonic() - start, _last_json(output))


def python_module(name: str, *arguments: str) -> list[str]:
    """Return the command that runs a module with this interpreter."""
    return [sys.executable, "-m", name, *arguments]


def _watch(process: subprocess.Popen[bytes]) -> tuple[int, int]:
    own = psutil.Process(process.pid)
    pids, searched_s = [process.pid], 0.0
    peak = peak_file = 0
    while process.poll() is None:
        if time.monotonic() - searched_s > SEARCH_S:
            searched_s = time.monotonic()
            try:
                pids = [process.pid, *(child.pid for child in own.children(recursive=True))]
            except psutil.Error:
                break
        beyond, mapped = zip(*(_resident(pid) for pid in pids))
        peak, peak_file = max(peak, sum(beyond)), max(peak_file, sum(mapped))
        time.sleep(LOOK_S)
    return peak, peak_file


def _resident(pid: int) -> tuple[int, int]:
    """Return resident bytes beyond the page cache and of mapped files; nothing of a process that has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0, 0
    kb = {line.split(":")[0]: int(line.split()[1]) for line in lines if line.startswith("Rss")}
    return 1024 * (kb.get("RssAnon", 0) + kb.get("RssShmem", 0)), 1024 * kb.get("RssFile", 0)


def _last_json(output: str) -> Mapping[str, Any]:
    lines = output.strip().splitlines()
    if not lines or not lines[-1].startswith("{"):
        return {}
    return json.loads(lines[-1])

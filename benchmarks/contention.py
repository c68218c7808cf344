"""One update, alone and beside a busy process, by how OpenMP's threads wait for each other.

``python -m benchmarks.contention`` compares how long they spin before they sleep: libgomp's default, not at all, and
what the library sets, ``GOMP_SPINCOUNT=3000``. The environment is a drifting picture: the library is what is timed.
"""

from __future__ import annotations

import contextlib
import functools
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Literal

import torch
import tyro

from benchmarks.measure import Loop, UpdateSettings, compare, run_sections
from benchmarks.synthetic import drifting_dataset
from crptpro.console import run_main

WAITS = {f"{spins} spins": {"GOMP_SPINCOUNT": spins} for spins in ("300000", "0", "3000")}


@dataclass(frozen=True, kw_only=True)
class Settings(UpdateSettings):
    """What to compare, at which size and how often."""

    only: tuple[Literal["pretrain", "downstream"], ...] = ("pretrain", "downstream")
    """loops"""
    busy: tuple[int, ...] = (0, 1)
    """numbers of busy processes beside it"""
    rounds: int = 7
    """timed rounds"""
    threads: int = torch.get_num_threads()
    """of torch"""
    transitions: int = 2_000
    """of the dataset and the replay"""


def main(settings: Settings) -> None:
    learned: dict[str, Any] = {**settings.sizes, "batch_size": settings.batch_size, "threads": settings.threads}
    with tempfile.TemporaryDirectory(prefix="crptpro-contention-", dir=settings.scratch) as scratch:
        path = drifting_dataset(scratch, transitions=settings.transitions, image_size=settings.image_size)
        items: dict[str, tuple[str, dict[str, Any]]] = {
            "pretrain": ("pretraining", {"datasets": [path]}),
            "downstream": ("downstream", {"transitions": settings.transitions, "features": "dense"}),
        }

        def measure(name: str) -> dict[str, Any]:
            item, own = items[name]
            found = {}
            with ExitStack() as stack:
                loops = {
                    wait: stack.enter_context(Loop(item, environment=environment, **learned, **own))
                    for wait, environment in WAITS.items()
                }
                for count in settings.busy:
                    with busy(count):
                        what = f"{name}, busy processes beside it: {count}"
                        found[str(count)] = compare(loops, unit=what, rounds=settings.rounds)
                        print()
            return found

        run_sections("contention", settings, {name: functools.partial(measure, name) for name in items})


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep processes computing meanwhile, each in a session of its own, as another user's are."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

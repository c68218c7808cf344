"""Another revision of the library beside this one, in turns: updates, a decision, sampling, opening, collecting.

``python -m benchmarks.revisions --old DIR`` runs every item of :mod:`benchmarks.loops` in one process per revision, one
round here and one round there. DIR is a checkout with the same interface; its own ``.venv``, where it has one, is used.
The environment is a drifting picture, whose steps cost next to nothing, so that the library is what is timed.
"""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.measure import ROOT, Loop, UpdateSettings, compare, run_sections
from crptpro.console import run_main
from crptpro.errors import CRPTproError

Item = Literal["pretrain", "downstream", "decision", "sample", "open", "collect"]


@dataclass(frozen=True, kw_only=True)
class Settings(UpdateSettings):
    """What to compare, at which size and how often."""

    old: Path
    """checkout of the other revision"""
    only: tuple[Item, ...] = ("pretrain", "downstream", "decision", "sample", "open", "collect")
    """items"""
    rounds: int = 7
    """timed rounds of each item in each revision, taken in turns"""
    threads: int = torch.get_num_threads()
    """of torch, in both"""
    transitions: int = 2_000
    """of each dataset and replay; dense features take 0.4 MB each in bf16, 0.8 in fp32, in both processes"""
    warmup: int = 8
    """rounds before the first timed one: today's replay encodes what it has not seen when it is drawn"""


def main(settings: Settings) -> None:
    old = settings.old.resolve()
    if not (old / "src" / "crptpro").is_dir():
        raise CRPTproError(f"{settings.old} has no src/crptpro: --old wants a checkout of another revision.")
    python = old / ".venv" / "bin" / "python"
    revisions = {"old": (old, python if python.exists() else sys.executable), "new": (ROOT, sys.executable)}
    images: dict[str, Any] = {"image_size": settings.image_size, "transitions": settings.transitions}
    learned: dict[str, Any] = {**settings.sizes, "batch_size": settings.batch_size}
    # Learned from a replay that the loop itself has filled at random.
    downstream: dict[str, Any] = {**images, **learned, "features": "dense", "is_filled": False}
    items: dict[str, dict[Item, Callable[[], Loop]]] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-revisions-", dir=settings.scratch) as scratch:
        for revision, (root, interpreter) in revisions.items():
            start = functools.partial(Loop, source=root, python=interpreter, threads=settings.threads)
            place = Path(scratch) / revision
            with start("collecting", root=place, **images) as collect:  # each revision reads what it has collected
                collect()
                collect()
            paths = sorted(place.glob("drifting_*"))
            items[revision] = {
                "pretrain": functools.partial(start, "pretraining", datasets=paths, **learned),
                "downstream": functools.partial(start, "downstream", of=("update",), **downstream),
                "decision": functools.partial(start, "downstream", **downstream),
                "sample": functools.partial(start, "sampling", path=paths[0], batch_size=settings.batch_size),
                "open": functools.partial(start, "opening", path=paths[0]),
                "collect": functools.partial(start, "collecting", root=place / "collected", **images),
            }

        def measure(name: Item) -> dict[str, Any]:
            with ExitStack() as stack:
                loops = {revision: stack.enter_context(starts[name]()) for revision, starts in items.items()}
                return compare(loops, unit=name, rounds=settings.rounds, warmup=settings.warmup)

        sections = {name: functools.partial(measure, name) for name in settings.only}
        described = {revision: describe(root) for revision, (root, _) in revisions.items()}
        run_sections("revisions", settings, sections, **described)


def describe(root: Path) -> str:
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+dirty", "--abbrev=12"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

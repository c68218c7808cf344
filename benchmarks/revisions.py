"""Another revision of the library beside this one, in turns: updates, a decision, sampling, opening, collecting.

``python -m benchmarks.revisions --old DIR`` runs every item of :mod:`benchmarks.loops` in one process per revision, one
round here and one round there. DIR is a checkout; its own ``.venv``, where it has one, is used. It may have the
interface of today or that of revision 40d9ae0. The world is a drifting picture that costs next to nothing: what is
left is the library.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarks.measure import ROOT, Loop, save, side_by_side, table
from crptpro.console import run_main
from crptpro.errors import CRPTproError


@dataclass(frozen=True)
class Settings:
    """What to compare, at which size and how often."""

    old: Path
    """checkout of the other revision"""
    only: tuple[str, ...] = ("pretrain", "downstream", "decision", "sample", "open", "collect")
    """items"""
    rounds: int = 7
    """timed rounds of each item in each revision, taken in turns"""
    threads: int = torch.get_num_threads()
    """of torch, in both"""
    batch_size: int = 512
    """transitions per update and per sample"""
    prototypes: int = 512
    """of loss and bonus"""
    image_size: int = 84
    """height and width in pixels"""
    transitions: int = 2_000
    """of each dataset and replay; dense features take 0.4 MB each in bf16, 0.8 in fp32, in both processes"""
    warmup: int = 8
    """rounds before the first timed one: today's replay encodes what it has not seen when it is drawn"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds.

    Raises:
        CRPTproError: for an item nobody knows, or a directory that is no checkout.
    """
    old = settings.old.resolve()
    if not (old / "src" / "crptpro").is_dir():
        raise CRPTproError(f"{settings.old} has no src/crptpro: --old wants a checkout of another revision.")
    python = old / ".venv" / "bin" / "python"
    revisions = {"old": (old, python if python.exists() else sys.executable), "new": (ROOT, sys.executable)}
    images: dict[str, Any] = {"image_size": settings.image_size, "transitions": settings.transitions}
    learned = {"prototypes": settings.prototypes, "batch_size": settings.batch_size}
    # Learned from a replay that the loop itself has filled at random.
    downstream = {**images, **learned, "features": "dense", "is_filled": False}
    items: dict[str, tuple[str, tuple[str, ...], dict[str, Any]]] = {
        "pretrain": ("pretraining", (), {**learned, "image_size": settings.image_size}),
        "downstream": ("downstream", ("update",), downstream),
        "decision": ("downstream", (), downstream),
        "sample": ("sampling", (), {"batch_size": settings.batch_size}),
        "open": ("opening", (), {}),
        "collect": ("collecting", (), images),
    }
    if unknown := [name for name in settings.only if name not in items]:
        raise CRPTproError(f"No items {', '.join(unknown)}; there are {', '.join(items)}.")
    results: dict[str, Any] = {which: describe(root) for which, (root, _) in revisions.items()}
    with tempfile.TemporaryDirectory(prefix="crptpro-revisions-") as scratch:
        own: dict[str, dict[str, Any]] = {}  # each revision reads what it has collected
        for which, (root, interpreter) in revisions.items():
            place = Path(scratch) / which
            common: dict[str, Any] = {"source": root, "python": interpreter, "threads": settings.threads}
            with Loop("datasets", root=place, **images, **common):
                paths = sorted(place.iterdir())
            more = {"pretraining": {"datasets": paths}, "sampling": {"path": paths[0]}, "opening": {"path": paths[0]}}
            own[which] = {**more, "collecting": {"root": place / "collected"}, "common": common}
        for name in settings.only:
            item, laps, sizes = items[name]
            with ExitStack() as stack:
                loops = {
                    which: stack.enter_context(Loop(item, of=laps, **sizes, **mine.get(item, {}), **mine["common"]))
                    for which, mine in own.items()
                }
                timings = side_by_side(loops, rounds=settings.rounds, warmup=settings.warmup)
            results[name] = table(timings, unit=name)
    save("revisions", settings, results, settings.out)
    return results


def describe(root: Path) -> str:
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+dirty", "--abbrev=12"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

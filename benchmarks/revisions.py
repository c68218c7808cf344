"""Another revision of the library beside this one: times in turns, memory, bytes on disk.

``python -m benchmarks.revisions --old DIR`` runs every item (:mod:`benchmarks.revision_items`) in one process per
revision, side by side, one round here and one round there. DIR is a checkout; its own ``.venv``, where it has one, is
used. It may have the interface of today or that of revision 40d9ae0. All items work on drifting pictures; the world of
``decision`` and ``collect`` costs next to nothing, so that what is left is the library.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tqdm.auto import tqdm

from benchmarks.measure import save, timing_of
from benchmarks.revision_items import ITEMS
from crptpro.console import run_main
from crptpro.errors import CRPTproError

DISK = "disk_bytes_per_transition"
ROOT = Path(__file__).parents[1]
UNITS = {
    "pretrain": "update", "downstream": "update, dense features", "decision": "decision, dense features",
    "dataset-sample": "batch", "replay-sample": "batch", "extend": "transition", "collect": "transition, one core",
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """What to compare, at which size and how often."""

    old: Path
    """checkout of the other revision"""
    only: tuple[str, ...] = tuple(ITEMS)
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
    decisions: int = 60
    """timed in each round of `decision`, after a replay of `batch_size` was stored"""
    old_python: Path | None = None
    """interpreter of the other revision (default: DIR/.venv/bin/python, or else this one)"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Measure, print the table, write the JSON, and return what it holds.

    Raises:
        CRPTproError: for an item nobody knows, a directory that is no checkout, or an item that fails.
    """
    if unknown := [name for name in settings.only if name not in ITEMS]:
        raise CRPTproError(f"No items {', '.join(unknown)}; there are {', '.join(ITEMS)}.")
    if not (settings.old / "src" / "crptpro").is_dir():
        raise CRPTproError(f"{settings.old} has no src/crptpro: --old wants a checkout of another revision.")
    results: dict[str, Any] = {}
    print("| item | one | old ms | new ms | new / old | memory, old MB | new MB | disk bytes, old | new |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in settings.only:
        found = results[name] = measure(name, settings)
        old, new = found["old"], found["new"]
        times = f"{1e3 * old['timing'].median_s:.3f} | {1e3 * new['timing'].median_s:.3f} | {found['new_over_old']:.2f}"
        memory = " | ".join(f"{one['facts']['resident_bytes'] / 1e6:.0f}" for one in (old, new))
        disk = " | ".join(f"{one['facts'][DISK]:.0f}" if DISK in one["facts"] else "" for one in (old, new))
        print(f"| {name} | {UNITS[name]} | {times} | {memory} | {disk} |", flush=True)
    revisions = {which: _revision(root) for which, root in (("old", settings.old), ("new", ROOT))}
    save("revisions", settings, {"revisions": revisions, "items": results}, out=settings.out)
    return results


def measure(name: str, settings: Settings) -> dict[str, Any]:
    """Run one item in both revisions, in turns."""
    sizes = {
        size: getattr(settings, size)
        for size in ("threads", "batch_size", "prototypes", "image_size", "transitions", "decisions")
    }
    venv = settings.old.resolve() / ".venv" / "bin" / "python"
    old_python = settings.old_python or (venv if venv.exists() else Path(sys.executable))
    with ExitStack() as stack:
        revisions = {
            which: stack.enter_context(Revision(root.resolve(), python, name, sizes))
            for which, root, python in (
                ("old", settings.old, old_python),
                ("new", ROOT, Path(sys.executable)),
            )
        }
        seconds: dict[str, list[float]] = {which: [] for which in revisions}
        for _ in tqdm(range(settings.rounds), desc=name, leave=False, disable=None):
            for which, revision in revisions.items():
                seconds[which].append(revision.round())
        found: dict[str, dict[str, Any]] = {
            which: {"timing": timing_of(seconds[which]), "facts": revision.facts}
            for which, revision in revisions.items()
        }
    ratio = found["new"]["timing"].median_s / found["old"]["timing"].median_s
    return {**found, "new_over_old": ratio}


class Revision:
    """A process that has set up one item in one checkout and does a round when it is asked.

    Args:
        root: of the checkout.
        python: its interpreter.
        item: name.
        sizes: of the item.

    Attributes:
        facts: what the process said of itself when it was ready.
    """

    def __init__(self, root: Path, python: Path, item: str, sizes: Mapping[str, Any]) -> None:
        self.root, self.item = root, item
        environment = {
            **os.environ,
            "PYTHONPATH": f"{root / 'src'}{os.pathsep}{root}",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        script = Path(__file__).with_name("revision_items.py")
        self._process = subprocess.Popen(
            [python, script, item, json.dumps(sizes)], cwd=root, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def __enter__(self) -> Revision:
        try:
            self.facts: dict[str, float] = self._answer()
        except BaseException:
            self.__exit__()
            raise
        return self

    def round(self) -> float:
        """Do one round; returns seconds per unit."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self._answer()

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()  # the process ends by itself
        self._process.wait()
        self._process.stdout.close()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        if not (line := self._process.stdout.readline()):
            raise CRPTproError(f"{self.item} failed in {self.root}; see its messages above.")
        return json.loads(line)


def _revision(root: Path) -> str:
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+dirty", "--abbrev=12"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

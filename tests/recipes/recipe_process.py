"""Recipes as a user starts them: one process each, on the real simulator, in the smallest sensible form."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

RECIPES = Path(__file__).parents[2] / "recipes"
SHORT_TASK = "gymnasium:Reacher-v5"
"""Real MuJoCo pixels with episodes of 25 decisions."""
SHORT_EPISODE = 25


def command_of(recipe: str, *flags: object) -> list[str]:
    return [sys.executable, str(RECIPES / f"{recipe}.py"), *map(str, flags)]


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "WANDB_MODE": "disabled"}


def run_recipe(recipe: str, *flags: object) -> subprocess.CompletedProcess[str]:
    """Run to the end; a failure shows what the recipe said."""
    done = subprocess.run(
        command_of(recipe, *flags),
        capture_output=True,
        text=True,
        timeout=300,
        env=environment(),
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert "Traceback" not in done.stderr
    return done


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def records(out: Path) -> dict[str, bytes]:
    """The bytes of every record and every weight below a directory."""
    names = ("*.csv", "*.jsonl", "*.safetensors", "*.memmap")
    return {
        str(path.relative_to(out)): path.read_bytes()
        for name in names
        for path in sorted(out.rglob(name))
        if "replay" not in path.parts
    }


def free_replays(out: Path) -> None:
    """Give back the gigabyte that each replay reserves."""
    for path in out.rglob("replay/*.memmap"):
        path.unlink()

"""Recipes as a user starts them: one process each, on the real simulator, in the smallest sensible form."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

RECIPES = Path(__file__).parents[2] / "recipes"
SHORT_TASK = "gymnasium:Reacher-v5"
"""Real MuJoCo pixels with episodes of 25 decisions."""
MEASURED = {"unix_time_s", "updates_per_s", "resident_bytes", "gpu_bytes"}


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


def kill_recipe(out: Path, sign: str, recipe: str, *flags: object) -> None:
    """Start a recipe and end it, and every process that it started, as soon as something below ``out`` matches."""
    process = subprocess.Popen(
        command_of(recipe, "--out", out, *flags),
        env=environment(),
        start_new_session=True,
        stderr=subprocess.PIPE,
    )
    deadline = time.monotonic() + 240
    while not any(out.glob(sign)):
        assert process.poll() is None, process.communicate()[1].decode()[-4000:]
        assert time.monotonic() < deadline, f"no {sign} appeared"
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "it had ended before it was killed"


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def records(out: Path) -> dict[str, object]:
    """Every record (without wall time and memory, which the last row of a pre-training measures anew) and weight."""
    kept: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        if path.suffix == ".csv":
            kept[str(path.relative_to(out))] = [
                {key: value for key, value in row.items() if key not in MEASURED} for row in rows(path)
            ]
        elif path.suffix in (".safetensors", ".memmap") and path.parent.name != "replay":
            kept[str(path.relative_to(out))] = path.read_bytes()
    return kept


def free_replays(out: Path) -> None:
    """Give back the gigabyte that each replay reserves."""
    for path in out.rglob("replay/*.memmap"):
        path.unlink()

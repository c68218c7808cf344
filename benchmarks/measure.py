"""Fair timing: candidates take turns, medians are compared, and the machine is recorded."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from crptpro.provenance import hardware, provenance

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of every benchmark."""

    image_size: int = 84
    """height and width in pixels"""
    scratch: Path | None = None
    """directory of temporary frames, not on a RAM disk; the system's temporary directory by default"""
    out: Path = ROOT / "build" / "benchmarks"
    """directory of the JSON file"""


@dataclass(frozen=True, kw_only=True)
class UpdateSettings(Settings):
    """Settings of every benchmark of updates."""

    batch_size: int = 512
    """transitions per update"""
    prototypes: int = 512
    """number in the pre-training loss and in the bonus"""

    @property
    def sizes(self) -> dict[str, Any]:
        """Sizes of every network and image."""
        return {"image_size": self.image_size, "prototypes": self.prototypes}


class Loop:
    """One of :mod:`benchmarks.loops` in its own process; a call continues it and returns seconds per unit.

    Args:
        item: name.
        of: the laps that count; all by default. ``laps`` holds all of the last call.
        **settings: of the item.
    """

    def __init__(self, item: str, *, of: Sequence[str] = (), **settings: Any) -> None:
        self.item, self.of = item, of
        path = os.pathsep.join(filter(None, [f"{ROOT / 'src'}", f"{ROOT}", os.environ.get("PYTHONPATH")]))
        variables = {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.loops", item, json.dumps(settings, default=str)], cwd=ROOT, text=True,
            env={**os.environ, **variables}, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self.laps = self._read()

    def __call__(self) -> float:
        """Run one unit, or several and take the mean."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        self.laps = self._read()
        return sum(self.laps[name] for name in self.of or self.laps)

    def __enter__(self) -> Loop:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate()  # it ends by itself when its standard input does

    def _read(self) -> dict[str, float]:
        assert self.process.stdout is not None
        if not (line := self.process.stdout.readline()):
            raise RuntimeError(f"{self.item} has failed; see its messages above.")
        return json.loads(line)


def compare(
    candidates: Mapping[str, Callable[[], Any]], *, unit: str, rounds: int, warmup: int = 2, per_call: int = 1,
    to: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Time candidates in turns, so that other load on the machine affects all of them alike.

    Times are per unit of work: a call does ``per_call`` of them, a :class:`Loop` returns how long one took. Prints
    times and their ratios to the candidate ``to`` (the last one by default), and returns what it prints.
    """
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for number in tqdm(range(-warmup, rounds), desc="rounds", leave=False, disable=None):
        for name, call in candidates.items():
            start = time.perf_counter()
            found = call()
            elapsed = (time.perf_counter() - start) / per_call
            if number >= 0:
                seconds[name].append(found if isinstance(call, Loop) else elapsed)
    to = to or list(candidates)[-1]
    reference = statistics.median(seconds[to])
    print(f"| one {unit} | median ms | best to worst ms | times '{to}' |\n|---|---|---|---|")
    timings, ratios = {}, {}
    for name, times in seconds.items():
        median, best, worst = statistics.median(times), min(times), max(times)
        timings[name] = {"median_s": median, "best_s": best, "worst_s": worst, "rounds": len(times)}
        ratios[name] = median / reference
        print(
            f"| {name} | {1e3 * median:.2f} | {1e3 * best:.2f} to {1e3 * worst:.2f} | {ratios[name]:.2f} |", flush=True
        )
    return {"unit": unit, "timings": timings, "times_slower": ratios, "than": to}


def run_sections(name: str, settings: Any, sections: Mapping[Any, Callable[[], Any]], **facts: Any) -> dict[str, Any]:
    """Run the sections that ``settings.only`` names; writes and returns ``facts`` and what the sections return."""
    results: dict[str, Any] = facts
    for section in settings.only:
        print(f"\n## {section}\n", flush=True)
        results[section] = sections[section]()
        # After each section: one that runs out of memory must not lose what has been measured.
        save(name, settings, results)
    return results


def save(name: str, settings: Settings, results: Mapping[str, Any]) -> None:
    """Write what was measured, how and on what, as ``<name>.json``, and print where."""
    facts = hardware()
    machine = (
        f"{torch.get_num_threads()} threads on {facts['cpu_cores']} cores of {facts['cpu']} "
        f"({facts['cpu_instructions']}){''.join(f', {gpu}' for gpu in facts['gpus'])}, load {os.getloadavg()[0]:.1f}"
    )
    content = {
        "benchmark": name,
        "command": " ".join(["python", "-m", f"benchmarks.{name}", *map(_without_place, sys.argv[1:])]),
        "settings": asdict(settings),
        "results": results,
        "machine": machine,
        **provenance(),
    }
    path = settings.out / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, default=_without_place) + "\n")
    print(f"\n{machine}\n{path}\n", flush=True)


def _without_place(argument: Any) -> str:
    """Return only the name of an absolute path: published results do not show the directories of a machine."""
    return Path(argument).name if Path(argument).is_absolute() else str(argument)

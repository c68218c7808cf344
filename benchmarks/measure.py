"""Fair timing: candidates take turns, medians are compared, and the machine is written down."""

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
PAPER_UPDATES, PAPER_ENV_STEPS = 50_000, 500_000


@dataclass(frozen=True)
class Timing:
    """Wall times of one candidate, seconds per unit of work."""

    median_s: float
    best_s: float
    worst_s: float
    rounds: int


def side_by_side(
    candidates: Mapping[str, Callable[[], Any]], *, rounds: int, warmup: int = 2, per_call: int = 1
) -> dict[str, Timing]:
    """Time candidates in turns, so that whatever else the machine does meets all of them alike.

    Times are per unit of work: a call does ``per_call`` of them, a :class:`Loop` says itself how long one took.
    """
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for number in tqdm(range(-warmup, rounds), desc="rounds", leave=False, disable=None):
        for name, call in candidates.items():
            start = time.perf_counter()
            found = call()
            elapsed = (time.perf_counter() - start) / per_call
            if number >= 0:
                seconds[name].append(found if isinstance(call, Loop) else elapsed)
    return {n: Timing(statistics.median(s), min(s), max(s), len(s)) for n, s in seconds.items()}


class Loop:
    """One of :mod:`benchmarks.loops` in a process of its own; a call lets it go on and returns seconds per unit.

    Args:
        item: name.
        of: the laps that count; all by default. ``laps`` holds all of the last call.
        source: checkout whose ``src`` is imported; this one by default.
        python: interpreter.
        **settings: of the item.
    """

    def __init__(
        self, item: str, *, of: Sequence[str] = (), source: Path = ROOT, python: Path | str = sys.executable,
        **settings: Any,
    ) -> None:  # fmt: skip
        self.item, self.of = item, of
        environment = {**os.environ, "PYTHONPATH": f"{source / 'src'}{os.pathsep}{ROOT}"}
        self.process = subprocess.Popen(
            [python, "-m", "benchmarks.loops", item, json.dumps(settings, default=str)], cwd=ROOT, text=True,
            env={**environment, "PYTHONDONTWRITEBYTECODE": "1"}, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self.laps = self._read()

    def __call__(self) -> float:
        """Do one unit, or the mean of some."""
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


def table(timings: Mapping[str, Timing], *, unit: str, to: str | None = None) -> dict[str, Any]:
    """Print times and their ratios to ``to`` (the last candidate by default); returns what it shows."""
    to = to or list(timings)[-1]
    ratios = {name: timing.median_s / timings[to].median_s for name, timing in timings.items()}
    print(f"| one {unit} | median ms | best to worst ms | times '{to}' |\n|---|---|---|---|")
    for name, t in timings.items():
        spread = f"{1e3 * t.best_s:.2f} to {1e3 * t.worst_s:.2f}"
        print(f"| {name} | {1e3 * t.median_s:.2f} | {spread} | {ratios[name]:.2f} |", flush=True)
    return {"unit": unit, "timings": timings, "times_slower": ratios, "than": to}


def save(name: str, settings: Any, results: Mapping[str, Any], out: Path | None) -> None:
    """Write what was measured, how and on what, as JSON (to ``benchmarks/results`` by default), and print where."""
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
    path = (out or ROOT / "benchmarks" / "results") / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, default=_plain) + "\n")
    print(f"\n{machine}\n{path}\n", flush=True)


def _without_place(argument: Any) -> str:
    """Results are published: where a directory lies on one machine is nobody's business, its name may be."""
    return Path(argument).name if Path(argument).is_absolute() else str(argument)


def _plain(value: Any) -> Any:
    return asdict(value) if isinstance(value, Timing) else _without_place(value)

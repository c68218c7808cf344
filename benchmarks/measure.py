"""Fair timing: candidates take turns, medians are compared, and the machine is written down."""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from crptpro.artifact import write_json
from crptpro.provenance import hardware, provenance

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Timing:
    """Wall times of one candidate, seconds per unit of work."""

    median_s: float
    best_s: float
    worst_s: float
    rounds: int


def timing_of(seconds: list[float]) -> Timing:
    """Return median, best and worst of at least one time."""
    return Timing(statistics.median(seconds), min(seconds), max(seconds), len(seconds))


def side_by_side(
    candidates: Mapping[str, Callable[[], Any]], *, rounds: int, warmup: int = 2, per_call: int = 1,
    device: torch.device | str = "cpu",
) -> dict[str, Timing]:  # fmt: skip
    """Time candidates in turns, so that whatever else the machine does meets all of them alike.

    Args:
        candidates: name to a call that does the work.
        rounds: timed calls of each.
        warmup: calls of each before the first timed one.
        per_call: units of work in a call; times are per unit.
        device: waited for before a clock is read.

    Raises:
        ValueError: fewer than one round.
    """
    if rounds < 1:
        raise ValueError(f"`rounds` must be at least 1, got {rounds}.")
    for call in candidates.values():
        for _ in range(warmup):
            call()
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in tqdm(range(rounds), desc="rounds", leave=False, disable=None):
        for name, call in candidates.items():
            _wait_for(device)
            start = time.perf_counter()
            call()
            _wait_for(device)
            seconds[name].append((time.perf_counter() - start) / per_call)
    return {name: timing_of(times) for name, times in seconds.items()}


def ratios(timings: Mapping[str, Timing], *, to: str) -> dict[str, float]:
    """Return how many times the time of ``to`` every candidate takes."""
    return {name: timing.median_s / timings[to].median_s for name, timing in timings.items()}


def report(timings: Mapping[str, Timing], *, unit: str, to: str | None = None) -> dict[str, Any]:
    """Print a table of times and of ratios to ``to`` (the last candidate by default); returns what it shows."""
    to = to or list(timings)[-1]
    slower = ratios(timings, to=to)
    print(f"One {unit}; times the time of '{to}'.\n")
    print("| candidate | median ms | best to worst ms | times |\n|---|---|---|---|")
    for name, t in timings.items():
        spread = f"{1e3 * t.best_s:.2f} to {1e3 * t.worst_s:.2f}"
        print(f"| {name} | {1e3 * t.median_s:.2f} | {spread} | {slower[name]:.2f} |", flush=True)
    return {"unit": unit, "timings": timings, "times_slower": slower, "than": to}


def machine() -> str:
    """Return one line about what the times were measured on."""
    facts = hardware()
    cpu = f"{torch.get_num_threads()} threads on {facts['cpu_cores']} cores of {facts['cpu']}"
    gpus = "".join(f", {name}" for name in facts["gpus"])
    return (
        f"{cpu} ({facts['cpu_instructions']}){gpus}, torch {torch.__version__}, load {os.getloadavg()[0]:.1f}"
    )


def save(name: str, settings: Any, results: Mapping[str, Any], *, out: Path | None = None) -> Path:
    """Write what was measured, how and on what, as JSON, and print where.

    Args:
        name: of the benchmark; the file is called so.
        settings: the benchmark's dataclass.
        results: plain values and :class:`Timing`.
        out: directory; ``benchmarks/results`` by default.
    """
    arguments = [_without_place(argument) for argument in sys.argv[1:]]
    content = {
        "benchmark": name,
        "command": " ".join(["python", "-m", f"benchmarks.{name}", *arguments]),
        "settings": _plain(asdict(settings)),
        "results": _plain(results),
        "machine": machine(),
        **provenance(),
    }
    path = (out or RESULTS) / f"{name}.json"
    write_json(path, content)
    print(f"\n{machine()}\n{path}\n", flush=True)
    return path


def _without_place(argument: str) -> str:
    """Results are published: where a directory lies on one machine is nobody's business, its name may be."""
    return Path(argument).name if Path(argument).is_absolute() else argument


def _plain(value: Any) -> Any:
    if isinstance(value, Timing):
        return asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return _without_place(str(value))
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value


def _wait_for(device: torch.device | str) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)

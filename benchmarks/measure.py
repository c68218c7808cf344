"""Fair timing: candidates take turns in one process, medians are compared, and the machine is written down."""

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

from crptpro.cards import provenance, write_json

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Timing:
    """Wall times of one candidate.

    Args:
        median_s: median over the rounds, seconds per call.
        best_s: shortest.
        worst_s: longest.
        rounds: calls that were timed.
    """

    median_s: float
    best_s: float
    worst_s: float
    rounds: int


def side_by_side(
    candidates: Mapping[str, Callable[[], Any]],
    *,
    rounds: int,
    warmup: int = 2,
    device: torch.device | str = "cpu",
) -> dict[str, Timing]:
    """Time candidates in turns, so that whatever else the machine does meets all of them alike.

    Args:
        candidates: name to a call that does the work once.
        rounds: timed calls of each.
        warmup: calls of each before the first timed one.
        device: waited for before a clock is read.

    Raises:
        ValueError: fewer than one round.
    """
    if rounds < 1:
        raise ValueError(f"`rounds` must be at least 1, got {rounds}.")
    device = torch.device(device)
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
            seconds[name].append(time.perf_counter() - start)
    return {
        name: Timing(statistics.median(times), min(times), max(times), rounds)
        for name, times in seconds.items()
    }


def ratios(timings: Mapping[str, Timing], *, to: str) -> dict[str, float]:
    """Return how many times faster than every candidate ``to`` is (its own ratio is 1)."""
    return {name: timing.median_s / timings[to].median_s for name, timing in timings.items()}


def table(timings: Mapping[str, Timing], *, to: str) -> str:
    """Return a Markdown table: median, spread, and how many times ``to`` is faster.

    Args:
        timings: from :func:`side_by_side`.
        to: the candidate whose ratios are shown.
    """
    faster = ratios(timings, to=to)
    lines = ["| candidate | median ms | best to worst ms | times slower |", "|---|---|---|---|"]
    for name, t in timings.items():
        spread = f"{1e3 * t.best_s:.1f} to {1e3 * t.worst_s:.1f}"
        lines.append(f"| {name} | {1e3 * t.median_s:.1f} | {spread} | {faster[name]:.2f} |")
    return "\n".join(lines)


def save(name: str, settings: Any, results: Mapping[str, Any], *, out: Path | None = None) -> Path:
    """Write what was measured, how and on what, as JSON.

    Args:
        name: of the benchmark; the file is called so.
        settings: the benchmark's dataclass.
        results: JSON-able; timings may be :class:`Timing`.
        out: directory; ``benchmarks/results`` by default.

    Returns:
        The file.
    """
    arguments = [_without_place(argument) for argument in sys.argv[1:]]
    content = {
        "benchmark": name,
        "command": " ".join(["python", "-m", f"benchmarks.{name}", *arguments]),
        "settings": _plain(asdict(settings)),
        "results": _plain(results),
        "threads": torch.get_num_threads(),
        "load_average_at_end": os.getloadavg()[0],
        **provenance(),
    }
    path = (out or RESULTS) / f"{name}.json"
    write_json(path, content)
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


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)

"""How fast ``collect_random`` is with one worker process and with several."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from crptpro.data import collect_random
from crptpro.data.episode_writer import read_journal
from crptpro.data.layout import JOURNAL_FILE
from crptpro.domains import Domain
from crptpro.quality import Quality


def worker_rates(
    domain: str | Domain,
    work: Path,
    *,
    workers: tuple[int, ...],
    transitions: int,
    rounds: int,
    quality: Quality,
) -> dict[int, dict[str, float | None]]:
    """Collect with several numbers of workers and return transitions/s, medians over the rounds.

    Returns:
        By number of workers: ``whole``, from call to return; ``steady``, after each worker's first episode, that
        is without starting processes, ``None`` if nothing was left to collect then.
    """
    rates: dict[int, list[tuple[float, float | None]]] = {count: [] for count in workers}
    for _ in range(rounds if workers else 0):
        for count in workers:
            with tempfile.TemporaryDirectory(dir=work) as root:
                start = time.perf_counter()
                path = collect_random(
                    domain, root, transitions=transitions, workers=count, quality=quality, progress=False
                )
                whole = transitions / (time.perf_counter() - start)
                rest = read_journal(path / JOURNAL_FILE)[count:]
                rest_s = sum(entry.wall_s for entry in rest)
                steady = sum(entry.transitions for entry in rest) / rest_s if rest_s else None
            rates[count].append((whole, steady))
    return {
        count: {"whole": _median(whole for whole, _ in found), "steady": _median(s for _, s in found)}
        for count, found in rates.items()
    }


def worker_table(by_count: Mapping[int, Mapping[str, float | None]]) -> str:
    """Return a Markdown table of what :func:`worker_rates` returned; ratios are to the first number."""
    first = next(iter(by_count))
    lines = [
        f"| workers | transitions/s, running | times {first} | transitions/s, with start | times {first} |",
        "|---|---|---|---|---|",
    ]
    for count, rates in by_count.items():
        cells = []
        for kind in ("steady", "whole"):
            rate, base = rates[kind], by_count[first][kind]
            cells += ["", ""] if rate is None or base is None else [f"{rate:.1f}", f"{rate / base:.2f}"]
        lines.append(f"| {count} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _median(values: Iterator[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return statistics.median(found) if found else None

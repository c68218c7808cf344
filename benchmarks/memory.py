"""Bytes on disk and memory of each stage: collection, pre-training, downstream.

``python -m benchmarks.memory`` runs every stage in a process of its own and watches it and its children from outside.
Memory means anonymous memory, beyond the page cache: the frames on disk are mapped, and their pages are given back
whenever something else needs the memory. Collection renders; other pixels are drifting pictures. The processes that
evaluate a downstream run come on top, 0.5 GB each.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import psutil
import tyro

from benchmarks.measure import Loop, UpdateSettings, save
from benchmarks.synthetic import drifting_dataset
from crptpro.console import run_main


@dataclass(frozen=True, kw_only=True)
class Settings(UpdateSettings):
    """The sizes at which each stage is measured."""

    task: str = "cheetah_run"
    """what is collected"""
    collect_transitions: int = 1_500
    """length of the collection; its memory does not grow with it"""
    dataset_transitions: int = 5_000
    """transitions of each of the three datasets of the pre-training"""
    updates: int = 6
    """updates of pre-training and downstream, an even number; the peak is reached in the first ones"""
    replay_transitions: int = 40_000
    """downstream replay"""
    features: tuple[Literal["dense", "reencode"], ...] = ("dense", "reencode")
    """downstream runs: dense features (16 GB at 40,000 transitions), or encoding at every update"""


def main(settings: Settings) -> None:
    image = {"image_size": settings.image_size}
    learned = {**settings.sizes, "batch_size": settings.batch_size}
    peaks: dict[str, int] = {"imports": peak_bytes("nothing")}
    disk: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-memory-", dir=settings.scratch) as directory:
        work = Path(directory)
        collected: dict[str, Any] = {"task": settings.task, "transitions": settings.collect_transitions, **image}
        peaks["collection"] = peak_bytes("rendering", root=work / "collected", **collected)
        disk["dataset"] = disk_bytes(work / "collected") / settings.collect_transitions
        sizes: dict[str, Any] = {**image, "transitions": settings.dataset_transitions}
        paths = [drifting_dataset(work, seed=seed, **sizes) for seed in range(3)]
        peaks["pre-training"] = peak_bytes(
            "pretraining", calls=settings.updates, datasets=paths, run_dir=work / "pretraining", **learned
        )
        for features in settings.features:
            with tempfile.TemporaryDirectory(dir=work) as run_dir:  # one replay on the disk at a time
                peaks[f"downstream, {features}"] = peak_bytes(
                    "downstream", calls=settings.updates // 2, features=features, run_dir=run_dir,
                    transitions=settings.replay_transitions, **learned,
                )  # fmt: skip
                disk[f"replay, {features}"] = disk_bytes(Path(run_dir)) / settings.replay_transitions
    print("| on disk | bytes per transition |\n|---|---|")
    for name, size in disk.items():
        print(f"| {name} | {size:,.0f} |")
    print("\n| memory beyond the page cache, peak of all processes | GB |\n|---|---|")
    for name, peak in peaks.items():
        print(f"| {name} | {peak / 1e9:.2f} |")
    save("memory", settings, {"peak_bytes": peaks, "bytes_per_transition": disk})


def peak_bytes(item: str, *, calls: int = 0, **settings: Any) -> int:
    """Run an item of :mod:`benchmarks.loops`; return the peak of its memory, children included."""
    me, peak, is_over = psutil.Process(), 0, threading.Event()

    def watch() -> None:
        nonlocal peak
        while not is_over.wait(0.02):
            peak = max(peak, sum(map(anonymous_bytes, me.children(recursive=True))))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        with Loop(item, **settings) as loop:
            for _ in range(calls):
                loop()
            time.sleep(0.05)
    finally:
        is_over.set()
        watcher.join()
    return peak


def anonymous_bytes(process: psutil.Process) -> int:
    with contextlib.suppress(psutil.Error):  # it has ended
        memory = process.memory_info()
        return memory.rss - memory.shared
    return 0


def disk_bytes(directory: Path) -> int:
    return sum(512 * file.stat().st_blocks for file in directory.rglob("*") if file.is_file())


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

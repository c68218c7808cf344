"""Bytes on disk and resident memory of each stage, beside the targets: collection, pre-training, downstream.

``python -m benchmarks.memory`` runs every stage in a process of its own (:mod:`benchmarks.stages`) and watches it from
outside. Resident means beyond the page cache (anonymous and shared memory): the frames on disk are mapped, and their
pages are given back whenever something else wants the memory. Collection and the downstream environments render;
other pixels are drifting pictures.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks import stages
from benchmarks.measure import save
from benchmarks.resident import Resident
from benchmarks.synthetic import write_dataset
from crptpro.cards import require_disk
from crptpro.console import run_main
from crptpro.data import FrameReplay, Layout
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder, resolve_precision
from crptpro.transforms import choose_feature_mode

logger = logging.getLogger("crptpro.benchmarks.memory")

PROJECTED_TRANSITIONS = 100_000
EPISODE_TRANSITIONS = 500
FRAME_BYTES = 3 * 84 * 84
#: GB, from the performance goals of this project.
TARGETS = {"disk": 2.2, "pretraining": 3.0, "downstream, dense": 20.0, "downstream, reencode": 4.0}


@dataclass(frozen=True)
class Settings:
    """The sizes at which each stage is measured."""

    task: str = "cheetah_run"
    """what is collected, and whose environments the downstream stage has"""
    collect_transitions: int = 1_500
    """length of the collection; its memory does not grow with it"""
    workers: int = 1
    """collecting processes"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality of the collection"""
    datasets: int = 3
    """domains of the pre-training"""
    dataset_transitions: int = 5_000
    """transitions of each"""
    batch_size: int = 512
    """transitions per update, of pre-training and downstream"""
    updates: int = 6
    """updates of each; the peak is reached in the first ones"""
    replay_transitions: int = 40_000
    """downstream replay"""
    features: tuple[Literal["dense", "reencode"], ...] = ("dense", "reencode")
    """downstream runs, by where features come from; dense ones at 40,000 transitions take 16 GB"""
    scratch: Path | None = None
    """where frames are written for the time being, not a RAM disk; the system's temporary directory by default"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Args:
        name: what was measured.
        value: GB (10^9 bytes).
        target: GB, if there is one.
        note: how it was measured.
    """

    name: str
    value: float
    target: float | None = None
    note: str = ""


def main(settings: Settings, run_stage: stages.Runner = stages.run_watched) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds.

    Raises:
        DiskSpaceError: if the frames do not fit the disk; nothing has been written then.
        CRPTproError: if the dense features do not fit the memory, or a stage fails.
    """
    disk: list[Row] = []
    resident: list[Row] = []
    found: dict[str, Resident] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-memory-", dir=settings.scratch) as directory:
        work = Path(directory)
        _announce(settings, work)
        found["imports"] = run_stage("imports", {})
        found["collection"] = run_stage("collection", _collection(settings, work))
        disk += _dataset_rows(found["collection"].answer)
        found["pretraining"] = run_stage("pretraining", _pretraining(settings, work))
        for mode in settings.features:
            with tempfile.TemporaryDirectory(dir=work) as run_dir:  # one replay on the disk at a time
                taken = run_stage("downstream", _downstream(settings, mode, run_dir))
            found[f"downstream, {mode}"] = taken
        if settings.features:
            disk += _replay_rows(found[f"downstream, {settings.features[-1]}"].answer)
    for name, taken in found.items():
        note = f"{taken.peak_file_bytes / 1e9:.2f} GB of mapped files besides"
        resident.append(Row(name, taken.peak_bytes / 1e9, TARGETS.get(name), note))
    results = {
        "disk": [asdict(row) for row in disk],
        "resident": [asdict(row) for row in resident],
        "stages": {name: asdict(taken) for name, taken in found.items()},
    }
    save("memory", settings, results, out=settings.out)
    print(f"\n`python -m benchmarks.memory {' '.join(sys.argv[1:])}`\n")
    print(f"On disk\n\n{_table(disk)}\n")
    print(f"Resident beyond the page cache, peak over all processes of a stage\n\n{_table(resident)}")
    return results


def _announce(settings: Settings, work: Path) -> None:
    """Say what will be written and taken, and refuse what does not fit."""
    frames = settings.collect_transitions + settings.datasets * settings.dataset_transitions
    replay = settings.replay_transitions if settings.features else 0
    # The ring has room for the frames that a checkpoint may still need: some 20 % at 40,000 transitions.
    size = FRAME_BYTES * (frames + replay * 1.05 + 8_000)
    logger.info("%.1f GB below %s, until the end", size / 1e9, work)
    require_disk(work, int(size), "Measuring the stages")
    if "dense" in settings.features:
        slots = _ring_rows(settings.replay_transitions)
        dtype = resolve_precision("auto", "cpu")
        mode, reason = choose_feature_mode("auto", PixelEncoder(), slots, dtype)
        if mode != "dense":
            raise CRPTproError(
                f"{reason}. Close what else takes memory, ask for fewer --replay-transitions, or --features reencode."
            )
        logger.info("downstream: %s", reason)


def _collection(settings: Settings, work: Path) -> dict[str, Any]:
    return {
        "task": settings.task,
        "root": str(work / "collected"),
        "transitions": settings.collect_transitions,
        "workers": settings.workers,
        "quality": settings.quality,
    }


def _pretraining(settings: Settings, work: Path) -> dict[str, Any]:
    paths = [
        write_dataset(work / f"domain_{index}", transitions=settings.dataset_transitions, seed=index)
        for index in range(settings.datasets)
    ]
    return {
        "datasets": [str(path) for path in paths],
        "run_dir": str(work / "pretraining"),
        "updates": settings.updates,
        "batch_size": settings.batch_size,
    }


def _downstream(settings: Settings, mode: str, run_dir: str) -> dict[str, Any]:
    return {
        "task": settings.task,
        "run_dir": run_dir,
        "features": mode,
        "replay_transitions": settings.replay_transitions,
        "updates": settings.updates,
        "batch_size": settings.batch_size,
        "episode_transitions": EPISODE_TRANSITIONS,
    }


def _dataset_rows(answer: Mapping[str, Any]) -> list[Row]:
    transitions, layout = answer["transitions"], Layout.from_dict(answer["layout"])
    episodes = -(-PROJECTED_TRANSITIONS // EPISODE_TRANSITIONS)
    projected = layout.bytes(PROJECTED_TRANSITIONS, PROJECTED_TRANSITIONS + episodes)
    return [
        Row(
            f"dataset of {transitions:,} transitions",
            answer["bytes_on_disk"] / 1e9,
            note=f"{answer['bytes_on_disk'] / transitions:,.0f} bytes per transition, every file counted",
        ),
        Row(
            f"dataset of {PROJECTED_TRANSITIONS:,}",
            projected / 1e9,
            TARGETS["disk"],
            f"{projected / PROJECTED_TRANSITIONS:,.0f} bytes per transition, from the layout, episodes of "
            f"{EPISODE_TRANSITIONS}",
        ),
    ]


def _replay_rows(answer: Mapping[str, Any]) -> list[Row]:
    transitions, slots = answer["transitions"], answer["frame_slots"]
    slack, size = slots - answer["window"], answer["replay_bytes_on_disk"]
    rows = [
        Row(
            f"replay of {transitions:,} transitions",
            size / 1e9,
            note=f"{size / transitions:,.0f} bytes per transition; {slots:,} rows, {slack:,} for checkpoints",
        )
    ]
    for label, extra in (("as downstream makes it", slack), ("without rows for checkpoints", 0)):
        projected = size / slots * (_ring_rows(PROJECTED_TRANSITIONS) + extra)
        note = f"{projected / PROJECTED_TRANSITIONS:,.0f} bytes per transition, projected"
        rows.append(
            Row(f"replay of {PROJECTED_TRANSITIONS:,}, {label}", projected / 1e9, TARGETS["disk"], note)
        )
    return rows


def _ring_rows(transitions: int) -> int:
    """Return the rows of a replay that keeps nothing for checkpoints; one of tiny frames has as many."""
    return FrameReplay(transitions, frame_shape=(1, 1, 1), action_dim=1).window


def _table(rows: list[Row]) -> str:
    lines = ["| what | GB | target GB | of the target | how |", "|---|---|---|---|---|"]
    for row in rows:
        target = ("", "") if row.target is None else (f"{row.target:g}", f"{row.value / row.target:.2f}")
        lines.append(f"| {row.name} | {row.value:.3f} | {target[0]} | {target[1]} | {row.note} |")
    return "\n".join(lines)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

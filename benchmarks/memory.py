"""Bytes on disk and resident memory of each stage: collection, pre-training, downstream.

``python -m benchmarks.memory`` runs every stage in a process of its own and watches it and its children from outside
(Linux: ``/proc``). Resident means beyond the page cache (anonymous and shared memory): the frames on disk are mapped,
and their pages are given back whenever something else wants the memory. Collection renders; other pixels are drifting
pictures. The processes that evaluate a downstream run come on top, 0.5 GB each.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import psutil
import tyro

from benchmarks.library import Downstream, fresh_loss, fresh_pretrained
from benchmarks.measure import save
from benchmarks.synthetic import make_drifting_env, write_dataset
from crptpro.artifact import require_disk
from crptpro.console import configure_logging, run_main
from crptpro.data import FrameDataset, collect_random
from crptpro.errors import CRPTproError
from crptpro.training import DownstreamConfig, pretrain

LOOK_S, SEARCH_S = 0.02, 0.5
"""Seconds between two looks at the memory, and between two searches for new children."""
TARGETS_GB = {"pretraining": 3.0, "downstream, auto": 20.0, "downstream, reencode": 4.0}
DISK_TARGET = 22_000
"""Bytes per transition: 2.2 GB for 100,000."""


@dataclass(frozen=True)
class Settings:
    """The sizes at which each stage is measured."""

    task: str = "cheetah_run"
    """what is collected"""
    collect_transitions: int = 1_500
    """length of the collection; its memory does not grow with it"""
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
    features: tuple[Literal["auto", "reencode"], ...] = ("auto", "reencode")
    """downstream runs: dense features (16 GB at 40,000 transitions), or encoding at every update"""
    scratch: Path | None = None
    """where frames are written for the time being, not a RAM disk; the system's temporary directory by default"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


@dataclass(frozen=True)
class Resident:
    """What a program took: peak bytes over all its processes beyond the page cache, and what it answered."""

    peak_bytes: int
    answer: dict[str, Any]


Runner = Callable[[str, dict[str, Any]], Resident]


def main(settings: Settings, run_stage: Runner | None = None) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds.

    Raises:
        DiskSpaceError: the frames do not fit the disk; nothing has been written then.
        CRPTproError: a stage fails.
    """
    run_stage = run_stage or run_watched
    sizes = {name: getattr(settings, name) for name in ("batch_size", "updates")}
    found: dict[str, Resident] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-memory-", dir=settings.scratch) as directory:
        work = Path(directory)
        frames = settings.collect_transitions + settings.datasets * settings.dataset_transitions
        needed = 3 * 84**2 * (frames + 2 * settings.replay_transitions)
        require_disk(work, needed, "Measuring the stages")
        found["imports"] = run_stage("imports", {})
        collecting = {"task": settings.task, "root": str(work), "transitions": settings.collect_transitions}
        found["collection"] = run_stage("collection", collecting)
        paths = [
            str(write_dataset(work / f"domain_{seed}", transitions=settings.dataset_transitions, seed=seed))
            for seed in range(settings.datasets)
        ]
        found["pretraining"] = run_stage(
            "pretraining", {"paths": paths, "run_dir": str(work / "run"), **sizes}
        )
        for features in settings.features:
            with tempfile.TemporaryDirectory(dir=work) as run_dir:  # one replay on the disk at a time
                facts = {"features": features, "transitions": settings.replay_transitions, "run_dir": run_dir}
                found[f"downstream, {features}"] = run_stage("downstream", {**facts, **sizes})
    print("| on disk | bytes per transition | target |\n|---|---|---|")
    for name, taken in found.items():
        if "bytes_per_transition" in taken.answer:
            print(f"| {name} | {taken.answer['bytes_per_transition']:,.0f} | {DISK_TARGET:,} |")
    print("\n| resident beyond the page cache, peak of all processes | GB | target |\n|---|---|---|")
    for name, taken in found.items():
        print(f"| {name} | {taken.peak_bytes / 1e9:.2f} | {TARGETS_GB.get(name, '')} |")
    results = {name: {"peak_bytes": taken.peak_bytes, **taken.answer} for name, taken in found.items()}
    save("memory", settings, results, out=settings.out)
    return results


# --- the stages, each called in a process of its own -----------------------------------------------------------------


def imports() -> dict[str, Any]:
    """Do nothing: what is resident then are the imports."""
    return {}


def collection(*, task: str, root: str, transitions: int) -> dict[str, Any]:
    """Collect a dataset."""
    path = collect_random(task, root, transitions=transitions)
    return {"bytes_per_transition": disk_bytes(path) / len(FrameDataset.open(path))}


def pretraining(*, paths: list[str], run_dir: str, updates: int, batch_size: int) -> dict[str, Any]:
    """Pre-train the paper's networks for a few updates, with a record and a checkpoint."""
    result = pretrain(
        fresh_loss(), paths, updates=updates, batch_size=batch_size, run_dir=run_dir, progress=False
    )
    return {"precision": result.training["settings"]["precision"]}


def downstream(
    *, features: Literal["auto", "reencode"], transitions: int, run_dir: str, updates: int, batch_size: int
) -> dict[str, Any]:
    """Fill the replay of a downstream run and update."""
    config = DownstreamConfig(
        env_steps=500_000, replay_capacity=transitions, random_agent_steps=1, batch_size=batch_size,
        features=features,
    )  # fmt: skip
    run = Downstream(fresh_pretrained(), config, env_factory=make_drifting_env, run_dir=Path(run_dir))
    run.fill(transitions)
    for _ in range(updates):
        run.update()
    return {"features": run.features, "bytes_per_transition": disk_bytes(Path(run_dir)) / transitions}


STAGES: dict[str, Callable[..., dict[str, Any]]] = {
    "imports": imports, "collection": collection, "pretraining": pretraining, "downstream": downstream,
}  # fmt: skip


def disk_bytes(directory: Path) -> int:
    """Return what the files below a directory take on disk."""
    return sum(512 * file.stat().st_blocks for file in directory.rglob("*") if file.is_file())


def child(name: str, arguments: str) -> None:
    """Run one stage; the last line printed is its answer."""
    configure_logging()
    print(json.dumps(STAGES[name](**json.loads(arguments))))


# --- watching --------------------------------------------------------------------------------------------------------


def run_watched(name: str, arguments: dict[str, Any]) -> Resident:
    """Run a stage in a process of its own and watch its memory."""
    code = "import sys; from benchmarks.memory import child; child(*sys.argv[1:])"
    return watch([sys.executable, "-c", code, name, json.dumps(arguments)])


def watch(command: list[str]) -> Resident:
    """Run a program to its end in the repository's root, looking at its memory and its children's every 20 ms.

    Raises:
        CRPTproError: it fails.
    """
    with tempfile.TemporaryFile("w+") as printed:
        process = subprocess.Popen(command, stdout=printed, cwd=Path(__file__).parents[1])
        try:
            peak = _peak(process)
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
        printed.seek(0)
        lines = printed.read().strip().splitlines()
    if process.returncode:
        raise CRPTproError(
            f"{' '.join(command)} ended with status {process.returncode}; see its messages above."
        )
    return Resident(peak, json.loads(lines[-1]) if lines else {})


def _peak(process: subprocess.Popen[bytes]) -> int:
    pids, searched_s, peak = [process.pid], 0.0, 0
    while process.poll() is None:
        if time.monotonic() - searched_s > SEARCH_S:
            searched_s = time.monotonic()
            try:
                children = psutil.Process(process.pid).children(recursive=True)
            except psutil.Error:
                break
            pids = [process.pid, *(found.pid for found in children)]
        peak = max(peak, sum(map(_resident_bytes, pids)))
        time.sleep(LOOK_S)
    return peak


def _resident_bytes(pid: int) -> int:
    """Return anonymous and shared memory; nothing of a process that has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0
    kb = {line.split(":")[0]: int(line.split()[1]) for line in lines if line.startswith("Rss")}
    return 1024 * (kb.get("RssAnon", 0) + kb.get("RssShmem", 0))


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

"""Sampling pairs of three-frame stacks: TorchRL's ways beside ours, in time, stored bytes and memory.

``python -m benchmarks.sampling`` needs no simulator: the frames are drifting pictures of the paper's size. Every way
holds the same transitions and returns the same keys, shapes and dtypes (:mod:`benchmarks.sampling_ways`). Where TorchRL
leaves both stacks as overlapping views of one block, they stay so; ours are two copies, which may be edited. Files are
in the page cache when the clock runs, as they are in training.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
import tyro
from tensordict import TensorDictBase
from torch import Tensor

from benchmarks import stages
from benchmarks.measure import Timing, ratios, save, side_by_side, table
from benchmarks.resident import Resident
from benchmarks.sampling_ways import WAYS
from benchmarks.synthetic import write_dataset
from crptpro.cards import require_disk
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.transforms.free_memory import free_bytes
from crptpro.transforms.random_shift import draw_offsets, random_shift

logger = logging.getLogger("crptpro.benchmarks.sampling")

SHIFT_PAD = 4
FRAMES_PER_TRANSITION = {
    "ours": 1, "stacked-disk": 6, "stacked-memory": 6, "catframes": 2, "slices": 1, "sequence": 1,
}  # fmt: skip
PIXEL_KEYS = ("pixels", ("next", "pixels"))


@dataclass(frozen=True)
class Settings:
    """What to compare and how often."""

    transitions: int = 20_000
    """stored transitions, in episodes of 500"""
    batch_size: int = 512
    """transitions per sample"""
    ways: tuple[str, ...] = tuple(WAYS)
    """which; the ratios are to the first one"""
    rounds: int = 15
    """timed samples of each way, taken in turns"""
    warmup: int = 2
    """samples of each way before the first timed one"""
    threads: int | None = None
    """torch threads, the same for every way; torch's own choice by default"""
    image_size: int = 84
    """height and width in pixels"""
    resident: bool = True
    """also measure the memory of each way, in a process of its own"""
    scratch: Path | None = None
    """where the frames are written for the time being; the system's temporary directory by default"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


def grid_shift(pixels: Tensor, offsets: Tensor, *, pad: int = SHIFT_PAD) -> Tensor:
    """Shift images as DrQ-v2 does (facebookresearch/drqv2 ``RandomShiftsAug``), by ``grid_sample``.

    Args:
        pixels: uint8 ``[B, C, H, W]``.
        offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.
        pad: largest shift in pixels.

    Returns:
        float32 ``[B, C, H, W]``, the exact shift to within a hundredth of a grey level.
    """
    batch, _, size, _ = pixels.shape
    padded = F.pad(pixels.float(), (pad, pad, pad, pad), mode="replicate")
    side = size + 2 * pad
    line = torch.linspace(-1 + 1 / side, 1 - 1 / side, side)[:size]
    column = line.unsqueeze(0).repeat(size, 1).unsqueeze(-1)
    base = torch.cat([column, column.transpose(0, 1)], dim=-1).expand(batch, size, size, 2)
    shift = offsets.flip(-1).float().view(batch, 1, 1, 2) * (2.0 / side)
    return F.grid_sample(padded, base + shift, padding_mode="zeros", align_corners=False)


def main(settings: Settings, run_stage: stages.Runner = stages.run_watched) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds.

    Raises:
        CRPTproError: for a way nobody knows, or frames that fit neither disk nor memory.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces storages on standard output
    unknown = [name for name in settings.ways if name not in WAYS]
    if unknown or not settings.ways:
        raise CRPTproError(f"ways must be some of {', '.join(WAYS)}; got {settings.ways}.")
    with tempfile.TemporaryDirectory(prefix="crptpro-sampling-", dir=settings.scratch) as work:
        _announce(settings, Path(work))
        path = write_dataset(
            Path(work) / "frames", transitions=settings.transitions, image_size=settings.image_size
        )
        resident = _resident(settings, path, run_stage) if settings.resident else {}
        with _threads(settings.threads):
            timings, shifted, stored = _times(settings, path, Path(work))
            used = torch.get_num_threads()
            results: dict[str, Any] = {
                "timings": timings,
                "times_slower": ratios(timings, to=settings.ways[0]),
                "with_shift": shifted,
                "stored_bytes_per_transition": stored,
                "peak_resident_bytes": {name: taken.peak_bytes for name, taken in resident.items()},
                "differences": {name: WAYS[name].differs for name in settings.ways},
                "threads": used,
            }
            save("sampling", settings, results, out=settings.out)
    print(f"\n`python -m benchmarks.sampling {' '.join(sys.argv[1:])}`\n")
    print(f"{settings.batch_size} of {settings.transitions:,} transitions, {used} thread(s)\n")
    print(_table(settings, timings, stored, resident))
    if shifted:
        print("\nWith a random shift of both stacks, drawn afresh for every image:\n")
        print(table(shifted, to=next(iter(shifted))))
    return results


def _times(
    settings: Settings, path: Path, work: Path
) -> tuple[dict[str, Timing], dict[str, Timing], dict[str, float]]:
    """Return timings, timings with the shift, and stored bytes per transition, by way."""
    dataset = FrameDataset.open(path)
    dataset.set_rng(torch.Generator().manual_seed(0))
    torch.manual_seed(0)
    samples: dict[str, Callable[[], TensorDictBase]] = {}
    stored: dict[str, float] = {}
    for name in settings.ways:
        logger.info("building %s", name)
        way = WAYS[name].build(dataset, settings.batch_size, work / name)
        samples[name], stored[name] = way.sample, way.stored_bytes / settings.transitions
    in_turns = functools.partial(side_by_side, rounds=settings.rounds, warmup=settings.warmup)
    timings = in_turns(samples)
    shifts = {
        "ours": ("`random_shift`, uint8", _exact_shift),
        "stacked-disk": ("`grid_sample`, float32", grid_shift),
    }
    with_shift = {
        f"{WAYS[name].what}, {label}": _then(samples[name], shift)
        for name, (label, shift) in shifts.items()
        if name in samples
    }
    return timings, in_turns(with_shift) if with_shift else {}, stored


def _exact_shift(pixels: Tensor, offsets: Tensor) -> Tensor:
    return random_shift(pixels, offsets, pad=SHIFT_PAD)


def _then(
    sample: Callable[[], TensorDictBase], shift: Callable[[Tensor, Tensor], Tensor]
) -> Callable[[], TensorDictBase]:
    def sample_and_shift() -> TensorDictBase:
        batch = sample()
        for key in PIXEL_KEYS:
            batch.set(key, shift(batch.get(key), draw_offsets(len(batch), SHIFT_PAD)))
        return batch

    return sample_and_shift


def _resident(settings: Settings, path: Path, run_stage: stages.Runner) -> dict[str, Resident]:
    """Return the memory of each way in a process of its own, and of one that only imports the same."""
    found = {"imports": run_stage("imports", {})}
    for name in settings.ways:
        logger.info("memory of %s", name)
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            arguments = {
                "way": name, "path": str(path), "batch_size": settings.batch_size, "scratch": scratch,
            }  # fmt: skip
            found[name] = run_stage("sampling", arguments)
    return found


def _announce(settings: Settings, work: Path) -> None:
    frame_bytes = 3 * settings.image_size**2
    sizes = {name: settings.transitions * FRAMES_PER_TRANSITION[name] * frame_bytes for name in settings.ways}
    on_disk = [size for name, size in sizes.items() if name not in ("ours", "stacked-memory")]
    # The frames themselves, one store per way, and one more at a time while memory is measured.
    disk = settings.transitions * frame_bytes + sum(on_disk) + max(on_disk, default=0)
    memory, free = sizes.get("stacked-memory", 0), free_bytes(torch.device("cpu"))
    logger.info("%.1f GB below %s and %.1f GB of memory, until the end", disk / 1e9, work, memory / 1e9)
    require_disk(work, disk, "Comparing the ways to sample")
    if memory > 0.8 * free:
        raise CRPTproError(
            f"`LazyTensorStorage` needs {memory / 1e9:.1f} GB, {free / 1e9:.1f} GB are free. Ask for fewer "
            "transitions, or leave stacked-memory out of --ways."
        )


def _table(
    settings: Settings, timings: dict[str, Timing], stored: dict[str, float], resident: dict[str, Resident]
) -> str:
    slower = ratios(timings, to=settings.ways[0])
    lines = [
        f"| way | median ms | best to worst ms | times {settings.ways[0]} | bytes per transition "
        "| peak MB beyond page cache | its samples differ in |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, t in timings.items():
        taken = f"{resident[name].peak_bytes / 1e6:,.0f}" if name in resident else "not measured"
        lines.append(
            f"| {WAYS[name].what} | {1e3 * t.median_s:.1f} | {1e3 * t.best_s:.1f} to {1e3 * t.worst_s:.1f} "
            f"| {slower[name]:.2f} | {stored[name]:,.0f} | {taken} | {WAYS[name].differs} |"
        )
    if "imports" in resident:
        taken = f"{resident['imports'].peak_bytes / 1e6:,.0f}"
        lines.append(f"| the imports alone | | | | | {taken} | |")
    return "\n".join(lines)


@contextlib.contextmanager
def _threads(count: int | None) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

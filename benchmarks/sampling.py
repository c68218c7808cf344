"""Sampling pairs of three-frame stacks: TorchRL's ways beside ours, in time and stored bytes.

``python -m benchmarks.sampling`` needs no simulator: the frames are drifting pictures of the paper's size. Every way
holds the transitions of one dataset and returns TensorDicts ``[B]`` of the same content: ``pixels`` and
``("next", "pixels")`` uint8 ``[B, 9, H, W]``, ``action``, ``("next", "reward" | "done" | "terminated" | "truncated")``,
``episode`` and ``step``. TorchRL's are written as its documentation shows, with every documented switch that makes them
faster. Where TorchRL leaves both stacks as overlapping views of one block, they stay so; ours are two copies, which may
be edited. Files are in the page cache when the clock runs, as they are in training.
"""

from __future__ import annotations

import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, ReplayBuffer, Sequence
from torchrl.data.replay_buffers.storages import Storage
from torchrl.envs.transforms import CatFrames

from benchmarks.measure import report, save, side_by_side
from benchmarks.synthetic import write_dataset
from crptpro.artifact import require_disk
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError

STACK = 3
OURS = ("number", ("next", "number"), "index")
"""What our samples have beside the others'."""


@dataclass(frozen=True)
class Way:
    """One way to sample: a call that returns a batch, and the bytes of all tensors it keeps."""

    sample: Callable[[], TensorDictBase]
    stored_bytes: int


def ours(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """Frames stored once, gathered into stacks by ``FrameDataset.sample``."""
    columns = [*dataset.frames.values(True, True), *dataset.transitions.values(True, True)]
    return Way(lambda: dataset.sample(batch_size), sum(column.nbytes for column in columns))


def stacked_on_disk(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """Both stacks of every transition in a ``LazyMemmapStorage``."""
    storage = LazyMemmapStorage(len(dataset), scratch_dir=scratch)
    buffer = ReplayBuffer(storage=storage, batch_size=batch_size)
    for part in torch.arange(len(dataset)).split(64):
        buffer.extend(dataset[part].exclude(*OURS))
    return Way(buffer.sample, _bytes(storage))


def catframes(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """``CatFrames.make_rb_transform_and_sampler`` over single frames; it wants the next frame stored as well."""
    transform, sampler = CatFrames(
        STACK, dim=-3, in_keys=["frame"], out_keys=["pixels"], reset_key="_reset"
    ).make_rb_transform_and_sampler(
        batch_size, traj_key="episode", cache_values=True, truncated_key=None, init_key=None
    )
    storage = LazyMemmapStorage(len(dataset), scratch_dir=scratch)
    buffer = ReplayBuffer(storage=storage, sampler=sampler, transform=transform, batch_size=batch_size)
    for rows, frames in _episodes(dataset):
        buffer.extend(rows.set("frame", frames[:-1]).set(("next", "frame"), frames[1:]))

    def sample() -> TensorDictBase:
        with warnings.catch_warnings():  # the sampler it comes with does not name the time axis it asks for
            warnings.filterwarnings(
                "ignore", message="The last dimension of the tensordict", category=UserWarning
            )
            return buffer.sample()

    return Way(sample, _bytes(storage))


def sequence(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """``sample_unit=Sequence(...)``, new in TorchRL 0.14, pads at episode starts; four frames side by side."""
    unit = Sequence(length=2, burn_in=STACK - 1, episode_boundary="stop", done_key="is_last_frame")
    storage = _frame_rows(dataset, scratch)
    buffer = ReplayBuffer(storage=storage, sample_unit=unit, batch_size=batch_size)
    return Way(lambda: _pair_of_stacks(buffer.sample()), _bytes(storage))


WAYS: dict[str, tuple[Callable[[FrameDataset, int, Path], Way], str, int]] = {
    "ours": (ours, "crptpro `FrameDataset.sample`", 0),
    "catframes": (catframes, "`CatFrames.make_rb_transform_and_sampler`", 2),
    "sequence": (sequence, "`Sequence`, stacked by hand", 1),
    "stacked": (stacked_on_disk, "stacks stored, `LazyMemmapStorage`", 6),
}
"""How to build each, what it is called in the table, and how many frames it stores per transition."""


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
    image_size: int = 84
    """height and width in pixels"""
    scratch: Path | None = None
    """where the frames are written for the time being; the system's temporary directory by default"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds.

    Raises:
        CRPTproError: for a way nobody knows.
        DiskSpaceError: for frames that do not fit the disk.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces storages on standard output
    unknown = [name for name in settings.ways if name not in WAYS]
    if unknown or not settings.ways:
        raise CRPTproError(f"ways must be some of {', '.join(WAYS)}; got {settings.ways}.")
    with tempfile.TemporaryDirectory(prefix="crptpro-sampling-", dir=settings.scratch) as directory:
        work = Path(directory)
        frames = settings.transitions * (1 + sum(WAYS[name][2] for name in settings.ways))
        require_disk(work, 3 * settings.image_size**2 * frames, "Comparing the ways to sample")
        sizes = {"transitions": settings.transitions, "image_size": settings.image_size}
        dataset = FrameDataset.open(
            write_dataset(work / "frames", **sizes), generator=torch.Generator().manual_seed(0)
        )
        torch.manual_seed(0)
        ways = {
            WAYS[name][1]: WAYS[name][0](dataset, settings.batch_size, work / name) for name in settings.ways
        }
        timings = side_by_side({name: way.sample for name, way in ways.items()}, rounds=settings.rounds)
        unit = f"batch of {settings.batch_size} out of {settings.transitions:,} transitions"
        results = report(timings, unit=unit, to=next(iter(ways)))
        results["stored_bytes_per_transition"] = {
            name: way.stored_bytes / settings.transitions for name, way in ways.items()
        }
        print("\n| way | bytes per transition |\n|---|---|")
        for name, size in results["stored_bytes_per_transition"].items():
            print(f"| {name} | {size:,.0f} |")
        save("sampling", settings, results, out=settings.out)
    return results


def _episodes(dataset: FrameDataset) -> Iterator[tuple[TensorDict, Tensor]]:
    """Yield every episode's columns ``[T]`` without pixels, and its frames ``[T + 1]``."""
    transitions = dataset.transitions
    for index in range(int(transitions["episode"].max()) + 1):
        rows = transitions[transitions["episode"] == index]
        yield rows.exclude("row"), dataset.frames["pixels"][rows["row"][0] + torch.arange(len(rows) + 1)]


def _frame_rows(dataset: FrameDataset, scratch: Path) -> LazyMemmapStorage:
    """Fill a storage with one row per frame: T + 1 per episode, the last one without a transition of its own."""
    storage = LazyMemmapStorage(len(dataset.frames), scratch_dir=scratch)
    buffer = ReplayBuffer(storage=storage)
    for columns, frames in _episodes(dataset):
        rows = columns[[*range(len(columns)), -1]].set("frame", frames)
        is_last = torch.zeros(len(rows), 1, dtype=torch.bool)
        is_last[-1] = True
        buffer.extend(rows.set("is_last_frame", is_last))
    return storage


def _pair_of_stacks(rows: TensorDictBase) -> TensorDictBase:
    """Turn runs of four frame rows ``[B * 4]`` into transitions ``[B]`` between the last two of each run."""
    runs = rows.reshape(-1, STACK + 1)
    frames = runs["frame"]
    pairs = runs[:, -2].exclude("frame", "is_last_frame")
    pairs["pixels"] = frames[:, :-1].flatten(1, 2)
    pairs["next", "pixels"] = frames[:, 1:].flatten(1, 2)
    return pairs


def _bytes(storage: Storage) -> int:
    return sum(column.nbytes for column in storage._storage.values(True, True))


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

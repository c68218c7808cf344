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

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, ReplayBuffer, Sequence
from torchrl.envs.transforms import CatFrames

from benchmarks import measure
from benchmarks.synthetic import drifting_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset

STACK = 3
OURS = "crptpro `FrameDataset.sample`"
MORE = ("number", ("next", "number"), "index")
"""Entries that only our samples have."""
Sample = Callable[[], TensorDictBase]


@dataclass(frozen=True, kw_only=True)
class Settings(measure.Settings):
    """What to compare and how often."""

    transitions: int = 20_000
    """stored transitions, in episodes of 500: 4 GB of files"""
    batch_size: int = 512
    """transitions per sample"""
    rounds: int = 15
    """timed samples of each way, taken in turns"""


def stacked(dataset: FrameDataset, batch_size: int, storage: LazyMemmapStorage) -> Sample:
    """Both stacks of every transition."""
    buffer = ReplayBuffer(storage=storage, batch_size=batch_size)
    for part in torch.arange(len(dataset)).split(64):
        buffer.extend(dataset[part].exclude(*MORE))
    return buffer.sample


def catframes(dataset: FrameDataset, batch_size: int, storage: LazyMemmapStorage) -> Sample:
    """``CatFrames.make_rb_transform_and_sampler`` over single frames; it wants the next frame stored as well."""
    transform, sampler = CatFrames(
        STACK, dim=-3, in_keys=["frame"], out_keys=["pixels"], reset_key="_reset"
    ).make_rb_transform_and_sampler(
        batch_size, traj_key="episode", cache_values=True, truncated_key=None, init_key=None
    )
    buffer = ReplayBuffer(storage=storage, sampler=sampler, transform=transform, batch_size=batch_size)
    for rows, frames in episodes(dataset):
        buffer.extend(rows.set("frame", frames[:-1]).set(("next", "frame"), frames[1:]))

    def sample() -> TensorDictBase:
        with warnings.catch_warnings():  # its sampler does not name the time axis that it needs
            warnings.filterwarnings("ignore", message="The last dimension of the tensordict")
            return buffer.sample()

    return sample


def sequence(dataset: FrameDataset, batch_size: int, storage: LazyMemmapStorage) -> Sample:
    """``sample_unit=Sequence(...)``, new in TorchRL 0.14, pads at episode starts; runs of four frames, stacked here.

    One row is stored per frame: T + 1 per episode, the last one without a transition of its own.
    """
    unit = Sequence(length=2, burn_in=STACK - 1, episode_boundary="stop", done_key="is_last_frame")
    buffer = ReplayBuffer(storage=storage, sample_unit=unit, batch_size=batch_size)
    for columns, frames in episodes(dataset):
        rows = columns[[*range(len(columns)), -1]].set("frame", frames)
        is_last = torch.arange(len(rows)).unsqueeze(1) == len(rows) - 1
        buffer.extend(rows.set("is_last_frame", is_last))

    def sample() -> TensorDictBase:
        runs = buffer.sample().reshape(-1, STACK + 1)
        pairs = runs[:, -2].exclude("frame", "is_last_frame")
        pairs["pixels"] = runs["frame"][:, :-1].flatten(1, 2)
        pairs["next", "pixels"] = runs["frame"][:, 1:].flatten(1, 2)
        return pairs

    return sample


WAYS = {
    "`CatFrames.make_rb_transform_and_sampler`": catframes,
    "`Sequence`, stacked by hand": sequence,
    "stacks stored, `LazyMemmapStorage`": stacked,
}
"""TorchRL's, as they are called in the table."""


def main(settings: Settings) -> None:
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces storages on standard output
    with tempfile.TemporaryDirectory(prefix="crptpro-sampling-", dir=settings.scratch) as directory:
        path = drifting_dataset(directory, transitions=settings.transitions, image_size=settings.image_size)
        dataset = FrameDataset.open(path)
        calls: dict[str, Sample] = {OURS: lambda: dataset.sample(settings.batch_size)}
        stored = {OURS: stored_bytes(dataset.frames) + stored_bytes(dataset.transitions)}
        for number, (name, way) in enumerate(WAYS.items()):
            storage = LazyMemmapStorage(len(dataset.frames), scratch_dir=Path(directory) / str(number))
            calls[name] = way(dataset, settings.batch_size, storage)
            stored[name] = stored_bytes(storage[: len(storage)])
        unit = f"batch of {settings.batch_size} out of {settings.transitions:,} transitions"
        results = measure.compare(calls, unit=unit, rounds=settings.rounds, to=OURS)
        results["stored_bytes_per_transition"] = {name: size / settings.transitions for name, size in stored.items()}
        print("\n| way | bytes per transition |\n|---|---|")
        for name, size in results["stored_bytes_per_transition"].items():
            print(f"| {name} | {size:,.0f} |")
        measure.save("sampling", settings, results)


def episodes(dataset: FrameDataset) -> Iterator[tuple[TensorDict, Tensor]]:
    """Yield every episode's columns ``[T]`` without pixels, and its frames ``[T + 1]``."""
    transitions = dataset.transitions
    for index in range(int(transitions["episode"].max()) + 1):
        rows = transitions[transitions["episode"] == index]
        yield rows.exclude("row"), dataset.frames["pixels"][rows["row"][0] + torch.arange(len(rows) + 1)]


def stored_bytes(columns: TensorDictBase) -> int:
    return sum(column.nbytes for column in columns.values(True, True))


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

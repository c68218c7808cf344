"""The ways to sample pairs of three-frame stacks that ``benchmarks.sampling`` compares: TorchRL's own, and ours.

Every way holds the transitions of one dataset and returns TensorDicts ``[B]`` of the same content: ``pixels`` and
``("next", "pixels")`` uint8 ``[B, 9, H, W]``, ``action``, ``("next", "reward" | "done" | "terminated" | "truncated")``,
``episode`` and ``step``. TorchRL's are written as its documentation shows, with every documented switch that makes
them faster (``cache_values=True``), and hold their frames in memory-mapped files unless they say otherwise.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer, Sequence
from torchrl.data.replay_buffers import SliceSampler
from torchrl.data.replay_buffers.storages import Storage
from torchrl.envs.transforms import CatFrames

from crptpro.data import FrameDataset

STACK = 3


@dataclass(frozen=True)
class Way:
    """One way to sample.

    Args:
        sample: Returns a batch.
        stored_bytes: Of all tensors it keeps, on disk or in memory.
    """

    sample: Callable[[], TensorDictBase]
    stored_bytes: int


@dataclass(frozen=True)
class Recipe:
    """How to build a way.

    Args:
        build: Called with the dataset, the batch size and an empty directory.
        what: For the table.
        differs: What its samples do not have in common with the others.
    """

    build: Callable[[FrameDataset, int, Path], Way]
    what: str
    differs: str = "nothing"


def ours(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """Frames stored once, gathered into stacks by ``FrameDataset.sample``."""
    columns = [*dataset.frames.values(True, True), *dataset.transitions.values(True, True)]
    return Way(lambda: dataset.sample(batch_size), sum(column.nbytes for column in columns))


def stacked_on_disk(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """Both stacks of every transition in a ``LazyMemmapStorage``."""
    return _stacked(dataset, batch_size, LazyMemmapStorage(len(dataset), scratch_dir=scratch))


def stacked_in_memory(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """Both stacks of every transition in a ``LazyTensorStorage``."""
    return _stacked(dataset, batch_size, LazyTensorStorage(len(dataset)))


def catframes(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """``CatFrames.make_rb_transform_and_sampler`` over single frames; it wants the next frame stored as well."""
    transform, sampler = CatFrames(
        STACK, dim=-3, in_keys=["frame"], out_keys=["pixels"], reset_key="_reset"
    ).make_rb_transform_and_sampler(
        batch_size, traj_key="episode", cache_values=True, truncated_key=None, init_key=None
    )
    storage = LazyMemmapStorage(len(dataset), scratch_dir=scratch)
    buffer = ReplayBuffer(storage=storage, sampler=sampler, transform=transform, batch_size=batch_size)
    for episode in _episodes(dataset):
        rows = episode.rows.set("frame", episode.frames[:-1])
        buffer.extend(rows.set(("next", "frame"), episode.frames[1:]))

    def sample() -> TensorDictBase:
        with warnings.catch_warnings():  # the sampler it comes with does not name the time axis it asks for
            warnings.filterwarnings(
                "ignore", message="The last dimension of the tensordict", category=UserWarning
            )
            return buffer.sample()

    return Way(sample, _bytes(storage))


def slices(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """``SliceSampler`` draws runs of four frames, which are laid side by side."""
    sampler = SliceSampler(
        slice_len=STACK + 1, traj_key="episode", cache_values=True, truncated_key=None, init_key=None
    )
    storage = _frame_rows(dataset, scratch)
    buffer = ReplayBuffer(storage=storage, sampler=sampler, batch_size=batch_size * (STACK + 1))
    return Way(lambda: _pair_of_stacks(buffer.sample()), _bytes(storage))


def sequence(dataset: FrameDataset, batch_size: int, scratch: Path) -> Way:
    """``sample_unit=Sequence(...)``, new in TorchRL 0.14, pads at episode starts; four frames side by side."""
    unit = Sequence(length=2, burn_in=STACK - 1, episode_boundary="stop", done_key="is_last_frame")
    storage = _frame_rows(dataset, scratch)
    buffer = ReplayBuffer(storage=storage, sample_unit=unit, batch_size=batch_size)
    return Way(lambda: _pair_of_stacks(buffer.sample()), _bytes(storage))


#: Ours first, then TorchRL's, by the name that ``--ways`` takes.
WAYS: dict[str, Recipe] = {
    "ours": Recipe(ours, "crptpro `FrameDataset.sample`"),
    "stacked-disk": Recipe(stacked_on_disk, "stacks stored, `LazyMemmapStorage`"),
    "stacked-memory": Recipe(stacked_in_memory, "stacks stored, `LazyTensorStorage`"),
    "catframes": Recipe(
        catframes,
        "`CatFrames.make_rb_transform_and_sampler`",
        "never draws the first two transitions of an episode",
    ),
    "slices": Recipe(
        slices, "`SliceSampler`, stacked by hand", "never draws the first two transitions of an episode"
    ),
    "sequence": Recipe(
        sequence, "`Sequence`, stacked by hand", "draws the last transition of an episode twice as often"
    ),
}


@dataclass(frozen=True)
class _EpisodeRows:
    rows: TensorDict
    """``[T]``, every column but pixels."""
    frames: Tensor
    """uint8 ``[T + 1, 3, H, W]``."""


def _episodes(dataset: FrameDataset) -> Iterator[_EpisodeRows]:
    transitions = dataset.transitions
    for index in range(int(transitions["episode"].max()) + 1):
        rows = transitions[transitions["episode"] == index]
        first = rows["row"][0]
        yield _EpisodeRows(rows.exclude("row"), dataset.frames_at(first + torch.arange(len(rows) + 1)))


def _stacked(dataset: FrameDataset, batch_size: int, storage: Storage) -> Way:
    buffer = ReplayBuffer(storage=storage, batch_size=batch_size)
    for part in torch.arange(len(dataset)).split(64):
        buffer.extend(dataset[part].exclude("row"))
    return Way(buffer.sample, _bytes(storage))


def _frame_rows(dataset: FrameDataset, scratch: Path) -> LazyMemmapStorage:
    """Fill a storage with one row per frame: T + 1 per episode, the last one without a transition of its own."""
    storage = LazyMemmapStorage(len(dataset.frames), scratch_dir=scratch)
    buffer = ReplayBuffer(storage=storage)
    for episode in _episodes(dataset):
        rows = episode.rows[[*range(len(episode.rows)), -1]].set("frame", episode.frames)
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

"""Frames stored once, on disk or in RAM, and the stacks that are made of them when they are read."""

from __future__ import annotations

import errno
import itertools
import math
import mmap
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_tensor_collection
from torch import Tensor
from torchrl.data.replay_buffers.checkpointers import StorageCheckpointerBase
from torchrl.data.replay_buffers.storages import Storage

from crptpro.errors import (
    CheckpointError,
    DatasetError,
    DiskSpaceError,
    NonFiniteError,
    is_disk_full,
    writing_error,
)
from crptpro.host_memory import empty_batch

FORMAT, VERSION = "crptpro-frames", 1
CARD_FILE, JOURNAL_FILE, COLLECTION_FILE = "card.json", "journal.jsonl", "collection.json"
FRAMES, TRANSITIONS = "frames", "transitions"
PIXELS_FILE = f"{FRAMES}/pixels.memmap"

#: What a card says about its pixels: their type and range, unscaled.
PIXELS = "uint8 0..255"

# Not in the mmap module of every Python; without it a mapping larger than RAM could be refused.
_MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)


# --- the files of a dataset ------------------------------------------------------------------------------------------


class Column(NamedTuple):
    """One raw little-endian file: rows of ``shape``, under a TensorDict key."""

    part: Literal["frames", "transitions"]
    key: tuple[str, ...]
    dtype: str
    shape: tuple[int, ...]

    @property
    def file(self) -> str:
        """The file's path inside the dataset, where ``TensorDict.load_memmap`` looks for it."""
        return "/".join((self.part, *self.key)) + ".memmap"

    @property
    def row_bytes(self) -> int:
        """Bytes per row."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Layout:
    """The shapes that fix every file of a dataset.

    Args:
        image_size: H = W, pixels.
        action_dim: length of an action vector.
        channels: channels of one frame.
        state: physical quantities stored per frame as float64, name to length (``qpos``, ``qvel``).
    """

    image_size: int
    action_dim: int
    channels: int = 3
    state: Mapping[str, int] = field(default_factory=dict)

    def columns(self) -> tuple[Column, ...]:
        """Every file, frames first, in the order in which checksums read them."""
        frame = (self.channels, self.image_size, self.image_size)
        flags = [("next", name) for name in ("done", "terminated", "truncated")]
        return (
            Column("frames", ("pixels",), "uint8", frame),
            *(Column("frames", (name,), "float64", (size,)) for name, size in sorted(self.state.items())),
            Column("transitions", ("action",), "float32", (self.action_dim,)),
            Column("transitions", ("next", "reward"), "float32", (1,)),
            *(Column("transitions", key, "bool", (1,)) for key in flags),
            Column("transitions", ("row",), "int64", ()),
            Column("transitions", ("step",), "int32", ()),
            Column("transitions", ("episode",), "int32", ()),
        )

    def sizes(self, transitions: int, frames: int) -> dict[str, int]:
        """Return each file's size in bytes."""
        rows = {FRAMES: frames, TRANSITIONS: transitions}
        return {column.file: column.row_bytes * rows[column.part] for column in self.columns()}

    def bytes(self, transitions: int, frames: int) -> int:
        """Return the size of all files in bytes, card and journal excepted."""
        return sum(self.sizes(transitions, frames).values())

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form that a card holds."""
        state = dict(sorted(self.state.items()))
        return {
            "image_size": self.image_size, "action_dim": self.action_dim, "channels": self.channels, "state": state
        }  # fmt: skip

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Layout:
        """Read what :meth:`to_dict` wrote."""
        sizes = {name: int(content[name]) for name in ("image_size", "action_dim", "channels")}
        return cls(**sizes, state={name: int(size) for name, size in content["state"].items()})


def estimate_bytes(transitions: int, image_size: int, episode_agent_steps: int | None) -> int:
    """Estimate a dataset's size before its action and state sizes are known (taken as 1 kB)."""
    episodes = -(-transitions // (episode_agent_steps or 100))
    return (transitions + episodes) * 3 * image_size**2 + transitions * 1000


def map_parts(path: Path, layout: Layout, transitions: int, frames: int) -> tuple[TensorDict, TensorDict]:
    """Map a dataset's frames without write access, and read its transitions, a few MB, into RAM."""
    rows = {FRAMES: frames, TRANSITIONS: transitions}
    parts = [
        TensorDict(
            {c.key: map_column(path / c.file, c, rows[part]) for c in layout.columns() if c.part == part},
            batch_size=[rows[part]],
        )
        for part in (FRAMES, TRANSITIONS)
    ]
    return parts[0], parts[1].clone()


def map_column(path: Path, column: Column, rows: int) -> Tensor:
    """Map a column's file without write access: it costs no memory, and writing to it leaves the file alone.

    Raises:
        DatasetError: if the file is missing or does not have exactly the expected size.
    """
    expected = rows * column.row_bytes
    dtype = getattr(torch, column.dtype)
    try:
        with open(path, "rb") as file:
            size = file.seek(0, 2)
            if size != expected:
                raise DatasetError(size_problem(path, size, expected))
            if not expected:
                return torch.empty(rows, *column.shape, dtype=dtype, device="cpu")
            flags = mmap.MAP_PRIVATE | _MAP_NORESERVE
            mapped = mmap.mmap(file.fileno(), expected, flags=flags, prot=mmap.PROT_READ | mmap.PROT_WRITE)
    except OSError as reason:
        raise DatasetError(
            f"{path} is missing or unreadable ({reason}). Collect the dataset again."
        ) from None
    return torch.frombuffer(mapped, dtype=dtype).view(rows, *column.shape)


def size_problem(path: Path, size: int, expected: int) -> str:
    """Say what is wrong with a file of ``size`` bytes where ``expected`` belong."""
    kind = "truncated" if size < expected else "longer than it should be"
    return f"{path} is {kind}: {size:,} bytes, the card promises {expected:,}. Collect the dataset again."


def write_tensordict_metadata(root: Path, layout: Layout, transitions: int, frames: int) -> None:
    """Turn the raw files under ``root`` into two memory-mapped TensorDicts by writing their metadata."""
    from tensordict import MemoryMappedTensor

    for part, rows in ((FRAMES, frames), (TRANSITIONS, transitions)):
        leaves = {
            column.key: MemoryMappedTensor.from_filename(
                root / column.file, getattr(torch, column.dtype), torch.Size((rows, *column.shape))
            )
            for column in layout.columns()
            if column.part == part
        }
        # memmap_ keeps a file that already lies where it would write it, so this adds the metadata only.
        TensorDict(leaves, batch_size=[rows]).memmap_(root / part)


# --- stacks ----------------------------------------------------------------------------------------------------------


def stack_rows(row: Tensor, step: Tensor, frame_stack: int) -> Tensor:
    """Return the frame rows of a stack, oldest to newest, int64 ``[B, frame_stack]``.

    Rows before the episode's first frame are that frame, as ``CatFrames(padding="same")`` does after a reset.

    Args:
        row: int64 ``[B]``, row of each observation's newest frame.
        step: ``[B]``, number of frames of the same episode before it.
        frame_stack: k, frames per stack.
    """
    age = torch.arange(frame_stack - 1, -1, -1, device=row.device)
    return row.unsqueeze(-1) - torch.minimum(age, step.to(torch.int64).unsqueeze(-1))


def gather_stacks(frames: Tensor, rows: Tensor) -> Tensor:
    """Gather ``[B, k]`` frame rows into stacks ``[B, k * C, H, W]``; contiguous, the dtype of ``frames``.

    Two separate gathers for an observation and its successor are faster than one of the k + 1 frames they
    share: the shared block would have to be copied again to be contiguous, and handing out overlapping views
    would let an in-place edit of one change the other.
    """
    batch, stack = rows.shape
    channels, *size = frames.shape[1:]
    flat = frames.reshape(len(frames), -1)
    shape = (batch * stack, flat.shape[1])
    stacks = empty_batch(shape, flat.dtype) if flat.device.type == "cpu" else flat.new_empty(shape)
    torch.index_select(flat, 0, rows.reshape(-1), out=stacks)
    return stacks.view(batch, stack * channels, *size)


# --- transitions as they come ----------------------------------------------------------------------------------------


class Rows(NamedTuple):
    """T transitions in temporal order.

    Args:
        stacks: uint8 ``[T, m * C, H, W]``, observations of m frames, oldest to newest.
        following: uint8 ``[T, C, H, W]``, the newest frame of the next observations.
        columns: everything else by name, ``[T, ...]``: ``action``, ``reward``, ``done``, ``terminated``, ``truncated``.
    """

    stacks: Tensor
    following: Tensor
    columns: dict[NestedKey, Tensor]

    @property
    def newest(self) -> Tensor:
        """The newest frame of the observations, ``[T, C, H, W]``."""
        return self.stacks[:, -self.following.shape[1] :]

    def starts(self, last: Tensor | None) -> list[int]:
        """Return which rows begin an episode.

        A row continues the one before if that one was not done and led to the frame that this one begins with.

        Args:
            last: the newest frame of what was stored before; ``None`` if no episode is running.
        """
        newest, found = self.newest, []
        if last is None or not torch.equal(newest[0], last):
            found.append(0)
        if len(newest) > 1:
            continues = (newest[1:] == self.following[:-1]).flatten(1).all(1) & ~self.columns["done"][:-1, 0]
            found += (1 + (~continues).nonzero().squeeze(-1)).tolist()
        return found

    def part(self, first: int, last: int) -> Rows:
        """Return rows ``first`` to ``last``, that one excluded."""
        columns = {name: values[first:last] for name, values in self.columns.items()}
        return Rows(self.stacks[first:last], self.following[first:last], columns)

    def first_frames(self) -> Tensor:
        """Return the first observation's frames without those that an episode's start repeats, ``[s, C, H, W]``."""
        frames = self.stacks[0].reshape(-1, *self.following.shape[1:])
        first = 0
        while first + 1 < len(frames) and torch.equal(frames[first], frames[first + 1]):
            first += 1
        return frames[first:]


def read_rows(
    data: TensorDictBase,
    *,
    channels: int,
    frame_stack: int,
    extra: Sequence[NestedKey] = (),
    what: str = "A replay",
) -> Rows:
    """Read what a TorchRL environment, rollout or collector hands out.

    Args:
        data: batch ``[T]`` in temporal order, or ``[]``.
        channels: C of a single frame.
        frame_stack: k; ``pixels`` are single frames or stacks of k.
        extra: further entries to read.
        what: is being written, for messages.

    Raises:
        ValueError: for entries that are missing or of another shape.
        NonFiniteError: for a reward or an action that is NaN or infinite.
    """
    if not is_tensor_collection(data) or data.ndim > 1:
        got = f"a batch {tuple(data.shape)}" if is_tensor_collection(data) else type(data).__name__
        raise ValueError(
            f"{what} takes transitions of one environment in temporal order, a TensorDict [T] or [], got {got}."
        )

    def entry(key: NestedKey, default: Tensor | None = None) -> Tensor:
        value = following.get(key[1], None) if isinstance(key, tuple) else data.get(key, None)
        if value is None:
            if default is None:
                found = sorted(map(str, data.keys(True, True)))
                raise ValueError(f"{what} needs {key!r} with every transition; there are {found}.")
            return default
        value = value if value.device.type == "cpu" else value.cpu()
        return value if data.ndim else value.unsqueeze(0)

    def column(name: str, default: Tensor | None = None) -> Tensor:
        value = entry(("next", name), default)
        return value if value.ndim == 2 else value.reshape(len(value), 1)

    following = data.get("next", TensorDict({}, data.shape))
    stacks, next_stacks = entry("pixels"), entry(("next", "pixels"))
    for pixels in (stacks, next_stacks):
        fits = pixels.ndim == 4 and pixels.shape[1] in (channels, frame_stack * channels)
        if not fits or pixels.dtype != torch.uint8:
            raise ValueError(
                f"{what} takes uint8 pixels [{channels} or {frame_stack * channels}, H, W], got {pixels.dtype} "
                f"{tuple(pixels.shape[1:])}."
            )
    columns = {"action": entry("action"), "reward": column("reward"), "done": (done := column("done"))}
    for name, values in (("reward", columns["reward"]), ("action", columns["action"])):
        if not (finite := torch.isfinite(values)).all():
            row = int((~finite).flatten(1).any(1).nonzero()[0])
            raise NonFiniteError(
                f"The {name} of transition {row} is {values[row].tolist()}. {what} takes finite numbers only; "
                "mend the environment, or leave the episode out."
            )
    columns["terminated"] = terminated = column("terminated", done)
    columns["truncated"] = column("truncated", done & ~terminated)
    columns |= {name: entry(name) for name in extra}
    return Rows(stacks, next_stacks[:, -channels:], columns)


# --- storages --------------------------------------------------------------------------------------------------------


class StackStorage(Storage):
    """A TorchRL storage of transitions that keeps each frame once and makes the stacks when it is read.

    Frames are counted as they are stored; the ``number`` of an observation is that of its newest frame.

    Attributes:
        pixels: uint8 ``[rows, C, H, W]``; frame n lies in row ``n % rows``.
        step: ``[rows]``, frames of the same episode before each.
        frame_stack: k, frames per observation.
        returns_pixels: whether :meth:`get` makes the stacks.
    """

    pixels: Tensor
    step: Tensor
    frame_stack: int
    returns_pixels: bool = True
    device: torch.device

    def columns_at(self, index: Tensor, **how: Any) -> TensorDict:
        """Return everything but pixels of transitions ``[B]``, with both observations' numbers."""
        raise NotImplementedError

    def held(self) -> range:
        """Return the numbers of the frames that can be read."""
        raise NotImplementedError

    def load(self) -> None:
        """Read what has been written since."""

    def get(self, index: Any, **how: Any) -> TensorDict:
        """Return transitions; 0 is the oldest.

        Args:
            index: an int, a slice, a mask, or integers of any shape.
            **how: of :meth:`columns_at`.

        Raises:
            IndexError: if an index is out of range.
        """
        self.load()
        positions = self._positions(index)
        flat = positions.reshape(-1)
        sample = self.columns_at(flat, **how).set("index", flat)
        if self.returns_pixels:
            sample.set("pixels", self.stacks(sample.get("number")))
            sample.set(("next", "pixels"), self.stacks(sample.get(("next", "number"))))
        return sample if positions.ndim == 1 else sample.reshape(positions.shape)

    def stack_rows_of(self, numbers: Tensor) -> Tensor:
        """Return the rows of :attr:`pixels` that make up observations, int64 ``[B, k]``, oldest to newest."""
        rows = len(self.pixels)
        return stack_rows(numbers, self.step[numbers % rows], self.frame_stack) % rows

    def stacks(self, numbers: Tensor) -> Tensor:
        """Return observations ``[B]`` by their numbers, uint8 ``[B, k * C, H, W]``."""
        return gather_stacks(self.pixels, self.stack_rows_of(numbers))

    def observations(self, numbers: Tensor) -> Tensor:
        """Return observations by number, uint8 ``[B, k * C, H, W]``.

        Raises:
            DatasetError: if a frame of one of them is not there, or no longer.
        """
        self.load()
        numbers, held = torch.as_tensor(numbers, dtype=torch.int64, device=self.device), self.held()
        first = numbers - torch.clamp(self.step[numbers % len(self.pixels)], max=self.frame_stack - 1)
        gone = (first < held.start) | (numbers >= held.stop)
        if gone.any():
            raise DatasetError(
                f"Observation {int(numbers[gone][0])} is not stored; there are {held.start} to {held.stop - 1}."
            )
        return self.stacks(numbers)

    def _positions(self, index: Any) -> Tensor:
        if isinstance(index, tuple) and len(index) == 1:
            index = index[0]
        length = len(self)
        if isinstance(index, slice):
            return torch.arange(*index.indices(length), device=self.device)
        positions = torch.as_tensor(index, device=self.device)
        if positions.dtype is torch.bool:
            return positions.nonzero().squeeze(-1)
        positions = positions.long()
        # On a GPU the comparison would wait for the device; there the gather itself checks its indices.
        is_checked = positions.numel() and positions.device.type == "cpu"
        if is_checked and not (-length <= int(positions.min()) and int(positions.max()) < length):
            raise IndexError(f"index {index} is out of range for {length} transitions.")
        return torch.where(positions < 0, positions + length, positions)

    def contains(self, item: Any) -> bool:
        """Whether there is a transition at an index."""
        return -len(self) <= int(item) < len(self)

    def set(self, *_: Any, **__: Any) -> None:
        """Refuse: rows depend on each other."""
        raise DatasetError("Frames are stored once, so that transitions depend on each other: use extend.")


class FrameStorage(StackStorage):
    """The rows of a dataset, read-only.

    The stack of transition i is made of rows ``row[i] - min(j, step[i])``, j = k-1 .. 0, and that of its
    successor ends at ``row[i] + 1``; both lie inside the episode, because an episode of T transitions has T +
    1 frames.

    Args:
        frames: TensorDict ``[F]`` with ``pixels`` uint8 ``[F, C, H, W]`` and optional physical state.
        transitions: TensorDict ``[N]`` with ``row`` int64, ``step``, and any per-transition columns.
        frame_stack: k, frames per stack.
        path: of the directory that they are mapped from.
        card: of the dataset.

    Raises:
        DatasetError: for a ``frame_stack`` below 1.
    """

    def __init__(
        self,
        frames: TensorDictBase,
        transitions: TensorDictBase,
        *,
        frame_stack: int = 3,
        path: Path | None = None,
        card: Mapping[str, Any] | None = None,
    ):
        if frame_stack < 1:
            raise DatasetError(f"frame_stack must be at least 1, got {frame_stack}.")
        super().__init__(len(transitions))
        self.frame_stack, self.path, self.card = frame_stack, path, dict(card or {})
        self._read: Callable[[], tuple[TensorDictBase, TensorDictBase]] | None
        self.replace(len(transitions), lambda: (frames, transitions))
        self.load()

    def replace(self, length: int, read: Callable[[], tuple[TensorDictBase, TensorDictBase]]) -> None:
        """Hold other rows from now on, which are read when they are needed."""
        self.max_size, self._read = length, read

    def load(self) -> None:
        """See the base class."""
        if self._read is None:
            return
        (self.frames, self.transitions), self._read = self._read(), None
        frames, transitions = self.frames, self.transitions
        self.pixels = frames.get("pixels")
        self.device = self.pixels.device
        row, step = transitions.get("row"), transitions.get("step").to(torch.int32)
        self.step = torch.zeros(len(frames), dtype=torch.int32, device=self.device)
        self.step[row + 1] = step + 1

    def __len__(self) -> int:
        return self.max_size

    def columns_at(self, index: Tensor, **how: Any) -> TensorDict:
        """See the base class."""
        columns = self.transitions.apply(lambda column: column.index_select(0, index), batch_size=index.shape)
        number = columns.pop("row")
        return columns.set("number", number).set(("next", "number"), number + 1)

    def held(self) -> range:
        """See the base class."""
        return range(len(self.pixels))

    def _empty(self) -> None:
        self.set()

    def state_dict(self) -> dict[str, Any]:
        """Return what tells this dataset from another one of the same shape: a checkpoint does not copy it."""
        names = ("domain", "task", "seed", "transitions", "frames", "quality", "action_repeat", "crc32")
        return {name: self.card.get(name) for name in names} | {"frame_stack": self.frame_stack}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Check that a checkpoint belongs to this dataset.

        Raises:
            DatasetError: if it was written with another one.
        """
        for name, mine in self.state_dict().items():
            if mine != state_dict.get(name):
                raise DatasetError(
                    f"The checkpoint was written with another dataset: {name} was {state_dict.get(name)}, "
                    f"{self.path} has {mine}. Open the dataset it was written with."
                )


class _StateCheckpointer(StorageCheckpointerBase):
    """Saves a storage's state dict: a reference to a dataset, the counters of a ring on disk, a ring in RAM."""

    def dumps(self, storage: StackStorage, path: str | Path) -> None:
        Path(path).mkdir(parents=True, exist_ok=True)
        torch.save(storage.state_dict(), Path(path) / "state.pt")

    def loads(self, storage: StackStorage, path: str | Path) -> None:
        storage.load_state_dict(torch.load(Path(path) / "state.pt", weights_only=True))


StackStorage._default_checkpointer = _StateCheckpointer


class RingStorage(StackStorage):
    """Frame rows in a ring of ``window + slack`` rows, and the valid transitions among them.

    A row holds one frame, and the transition that starts at it, if one does. A transition is valid while it
    is among the newest ``capacity`` and all its frames are among the newest ``window`` rows. So a state from
    a moment ago needs no row that was overwritten since, as long as at most ``slack`` rows were.

    Args:
        capacity: most transitions that are valid at once.
        window: rows that valid transitions may use.
        slack: further rows, which only restoring needs.
        columns: name to (shape, dtype) of every per-row quantity, ``pixels`` among them.
        frame_stack: k, frames per stack.
        root_columns: names that belong to a transition's observation; the others are returned under ``"next"``.
        n_step: n, agent steps from an observation to the next one of a sample.
        discount: gamma of the n-step return.
        path: directory of the memory-mapped files; RAM if ``None``.
    """

    COUNTERS = ("frames", "transitions", "oldest", "episode_step", "is_open")

    def __init__(
        self,
        capacity: int,
        *,
        window: int,
        slack: int,
        columns: Mapping[str, tuple[tuple[int, ...], torch.dtype]],
        frame_stack: int,
        root_columns: tuple[str, ...],
        n_step: int,
        discount: float,
        path: Path | None,
    ):
        super().__init__(capacity)
        self.device = torch.device("cpu")
        self.window, self.slack, self.frame_stack, self.path = window, slack, frame_stack, path
        self.rows, self.root_columns, self.n_step, self.discount = (
            window + slack,
            root_columns,
            n_step,
            discount,
        )
        # They only grow; a counter modulo the number of rows is a slot. `oldest` is the first valid transition.
        self.frames = self.transitions = self.oldest = self.episode_step = 0
        self.is_open = False
        # ``number`` is one more than the row's counter, 0 if it was never written; ``row_of`` belongs to
        # transitions, which have a counter of their own.
        own = {"step": torch.int32, "number": torch.int64, "row_of": torch.int64}
        self._maps: list[mmap.mmap] = []
        if path is not None:
            path.mkdir(parents=True, exist_ok=True)
        specs = {**columns, **{name: ((), dtype) for name, dtype in own.items()}}
        self.content: dict[NestedKey, Tensor] = {
            name: self._allocate(name, *spec) for name, spec in specs.items()
        }
        self.pixels, self.step = self.content["pixels"], self.content["step"]
        self.number, self.row_of = self.content["number"], self.content["row_of"]
        self.column_names = tuple(name for name in columns if name != "pixels")

    # -- writing

    def write(self, rows: Rows) -> Tensor:
        """Store transitions in temporal order; returns their observations' numbers, int64 ``[T]``."""
        total, numbers = len(rows.following), []
        for begin in range(0, total, self.max_size):
            part = rows if total <= self.max_size else rows.part(begin, begin + self.max_size)
            last = self.pixels[(self.frames - 1) % self.rows] if self.is_open else None
            starts = part.starts(last)
            edges = sorted({0, *starts, len(part.following)})
            for first, end in itertools.pairwise(edges):
                piece = part if (first, end) == (0, len(part.following)) else part.part(first, end)
                numbers.append(self._write_piece(piece, begins=first in starts))
        return numbers[0] if len(numbers) == 1 else torch.cat(numbers)

    def _write_piece(self, rows: Rows, *, begins: bool) -> Tensor:
        """Store transitions of one episode."""
        frames, lead = rows.following, 0
        if begins:
            first = rows.first_frames()
            frames, lead = torch.cat([first, frames]), len(first)
            self.episode_step = -1
        count, length = len(frames), len(rows.following)
        # Numbered before the rows are overwritten: a kill in between must not hide the loss.
        number = torch.arange(self.frames, self.frames + count, device="cpu")
        self._put("number", self.frames, number + 1)
        self._put("pixels", self.frames, frames)
        self._put("step", self.frames, number - self.frames + self.episode_step + 1)
        start = self.frames + lead - 1
        for name, values in rows.columns.items():
            self._put(name, start, values)
        number = number[:length] + (lead - 1)
        self._put("row_of", self.transitions, number)
        self.frames += count
        self.transitions += length
        self.episode_step += count
        self.is_open = not bool(rows.columns["done"][-1])
        self._evict()
        return number

    def _put(self, name: NestedKey, start: int, values: Tensor) -> None:
        column, slot, count = self.content[name], start % self.rows, len(values)
        if (room := self.rows - slot) >= count:
            column[slot : slot + count] = values
        else:  # round the ring
            column[slot:] = values[:room]
            self._put(name, start + room, values[room:])

    def _evict(self) -> None:
        oldest_row = self.frames - self.window
        while self.oldest < self.transitions:
            row = int(self.row_of[self.oldest % self.rows])
            first = row - min(self.frame_stack - 1, int(self.step[row % self.rows]))
            if first >= oldest_row and self.transitions - self.oldest <= self.max_size:
                return
            self.oldest += 1

    # -- reading

    def __len__(self) -> int:
        return self.transitions - self.oldest

    def held(self) -> range:
        """See the base class."""
        return range(max(0, self.frames - self.window), self.frames)

    def __getitem__(self, index: Any) -> TensorDict:
        # Not every transition has a window: indexing reads single ones.
        return self.get(index, n_step=1)

    def columns_at(self, index: Tensor, *, n_step: int | None = None) -> TensorDict:  # type: ignore[override]
        """See the base class; windows of :attr:`n_step` unless another number is given."""
        n_step = self.n_step if n_step is None else n_step
        number = self._numbers_at(index)
        row = number % self.rows
        # The transitions of a window follow one another in rows, and its last one leads to the next observation.
        last = row if n_step == 1 else (row + n_step - 1) % self.rows
        root, following = {"number": number}, {"number": number + n_step}
        for name in self.column_names:
            if name in self.root_columns:
                root[name] = self.content[name][row]
            else:
                following[name] = self.content[name][last]
        if n_step > 1:
            window = (row.unsqueeze(-1) + torch.arange(n_step, device="cpu")) % self.rows
            rewards, ended = self.content["reward"][window], self.content["terminated"][window]
            following["reward"], following["discount"] = n_step_return(rewards, ended, self.discount)
        return TensorDict({**root, "next": TensorDict(following, index.shape)}, index.shape)

    def has_window(self, index: Tensor) -> Tensor:
        """Whether n transitions from ``index`` on, ``[B]``, at most ``len - n``, are of one episode."""
        # An episode has one frame more than transitions, so between two of them the rows jump.
        ahead = self.n_step - 1
        return self._numbers_at(index + ahead) - self._numbers_at(index) == ahead

    def _numbers_at(self, index: Tensor) -> Tensor:
        return self.row_of[(self.oldest + index) % self.rows]

    # -- keeping

    def flush(self) -> None:
        """Write the memory-mapped rows to the disk; a kill of this process loses nothing even without it."""
        for mapped in self._maps:
            mapped.flush()

    def state_dict(self) -> dict[str, Any]:
        """Return the counters, and the rows themselves if they are in RAM."""
        self.flush()
        counters = {name: getattr(self, name) for name in self.COUNTERS}
        state: dict[str, Any] = {"counters": counters, "rows": self.rows, "window": self.window}
        if self.path is None:
            used = min(self.frames, self.rows)
            state["content"] = {name: column[:used].clone() for name, column in self.content.items()}
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to the content of the moment ``state_dict`` was taken.

        Raises:
            CheckpointError: if it belongs to a ring of another size, or its rows were overwritten since.
        """
        shape = (state_dict["rows"], state_dict["window"])
        if shape != (self.rows, self.window):
            raise CheckpointError(
                f"The replay's checkpoint has {shape[0]} rows, {shape[1]} of them in use; this replay has "
                f"{self.rows} and {self.window}. Use the capacity and slack it was written with."
            )
        counters = state_dict["counters"]
        if "content" in state_dict:
            for name, column in state_dict["content"].items():
                self.content[name][: len(column)] = column
        else:
            self._check_rows(counters["frames"])
        for name, value in counters.items():
            setattr(self, name, value)

    def _check_rows(self, frames: int) -> None:
        """Make sure that every row of a state's window still holds what it held then."""
        needed = torch.arange(max(0, frames - self.window), frames, device="cpu")
        lost = int((self.number[needed % self.rows] != needed + 1).sum())
        if lost:
            since = int(self.number.max()) - frames
            why = "the files were removed or replaced; put them back."
            if since > self.slack:
                why = (
                    f"{since} frames were written after it, with a slack of {self.slack}; begin again with a "
                    "larger one (a run has it from `checkpoint_interval_env_steps`), or use a newer checkpoint."
                )
            raise CheckpointError(f"{lost} rows that the checkpoint of {self.path} needs are gone: {why}")

    def _empty(self) -> None:
        self.oldest, self.is_open = self.transitions, False  # numbers go on: none is used twice

    def __getstate__(self) -> dict[str, Any]:
        # A copy cannot share the files that this ring goes on writing: it holds the rows in RAM.
        return {**super().__getstate__(), "_maps": [], "path": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.pixels, self.step = self.content["pixels"], self.content["step"]
        self.number, self.row_of = self.content["number"], self.content["row_of"]

    def _allocate(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        if self.path is None:
            return torch.zeros(self.rows, *shape, dtype=dtype, device="cpu")
        mapped = map_file(self.path / f"{name}.memmap", self.rows * math.prod(shape) * dtype.itemsize)
        self._maps.append(mapped)
        return torch.frombuffer(mapped, dtype=dtype).view(self.rows, *shape)


def n_step_return(rewards: Tensor, terminated: Tensor, discount: float) -> tuple[Tensor, Tensor]:
    r"""Discounted return of windows, and the discount of the value that follows (url_benchmark, replay_buffer.py).

    .. math::
        R = \sum_{i=0}^{n-1} \gamma^i \Big(\prod_{j<i} d_j\Big) r_i, \qquad
        D = \gamma^n \prod_{j=0}^{n-1} d_j

    with the environment's discount :math:`d_j = 0` where transition j terminated and 1 elsewhere.

    Args:
        rewards: ``[B, n, 1]``.
        terminated: bool ``[B, n, 1]``; a truncation is none.
        discount: gamma, in [0, 1].

    Returns:
        R and D, each ``[B, 1]``.
    """
    total, factor = torch.zeros_like(rewards[:, 0]), torch.ones_like(rewards[:, 0])
    for reward, ended in zip(rewards.unbind(1), terminated.unbind(1)):
        total = total + factor * reward
        factor = factor * (discount * (~ended).to(factor))
    return total, factor


def map_file(path: Path, size: int) -> mmap.mmap:
    """Map a file whose bytes are reserved, making it or keeping what is in it.

    Args:
        path: of the file, in an existing directory.
        size: bytes.

    Raises:
        CheckpointError: there is a file of another size.
        DiskSpaceError: the disk cannot hold it; nothing is left of what was reserved.
        OSError: naming the file, for any other reason.
    """
    found = path.stat().st_size if path.exists() else 0
    if found not in (0, size):
        raise CheckpointError(
            f"{path} has {found:,} bytes, this replay needs {size:,}: it belongs to a replay of another size. Use "
            "the capacity and slack it was written with, or another directory."
        )
    # A new one has its name once it is whole: a kill while it is reserved leaves nothing that looks like rows.
    partial = path.with_name(f".{path.name}.partial")
    # Not by open(path, "a+b"): a file system that cannot reserve has glibc write instead, which it refuses to do in a
    # file that is appended to.
    handle = os.open(path if found else partial, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        os.ftruncate(handle, found)  # drops what such a kill left, of whatever size
        try:
            # Reserved, not sparse: a disk that fills up later would end the process by a bus error.
            os.posix_fallocate(handle, 0, size)
        except OSError as reason:
            os.ftruncate(handle, found)  # what was reserved before the disk was full
            if is_disk_full(reason) or reason.errno == errno.EFBIG:
                raise DiskSpaceError(
                    f"{path} needs {size / 1e9:.2f} GB: {reason}. Free space, or choose another directory or a smaller "
                    "capacity."
                ) from reason
            raise writing_error(path, reason) from reason
        if not found:
            os.replace(partial, path)
        return mmap.mmap(handle, size)
    finally:
        os.close(handle)
        partial.unlink(missing_ok=True)

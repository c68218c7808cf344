"""The ring behind :class:`~crptpro.data.FrameReplay`: frame rows, and the transitions between them."""

from __future__ import annotations

import mmap
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import TensorStorage
from torchrl.data.replay_buffers.checkpointers import StorageCheckpointerBase

from crptpro.data.frame_stacks import gather_stacks, stack_rows
from crptpro.data.mapped_file import map_file
from crptpro.data.n_step import Reading, n_step_return
from crptpro.errors import CheckpointError

_OWN = ("pixels", "step", "number", "row_of")


@dataclass
class RingCursors:
    """Where the ring stands. Counters only grow; a counter modulo the number of rows is a slot.

    Args:
        frames: Frame rows written.
        transitions: Transitions written.
        oldest: The oldest transition that is still valid.
        step: Frames of the current episode before its newest one.
        is_open: An episode is running, so that ``append`` may follow.
    """

    frames: int = 0
    transitions: int = 0
    oldest: int = 0
    step: int = 0
    is_open: bool = False


class RingCheckpointer(StorageCheckpointerBase):
    """Saves a ring's state dict; the frames of a ring on disk stay where they are."""

    def dumps(self, storage: RingStorage, path: str | Path) -> None:
        """Write the state dict."""
        Path(path).mkdir(parents=True, exist_ok=True)
        torch.save(storage.state_dict(), Path(path) / "ring.pt")

    def loads(self, storage: RingStorage, path: str | Path) -> None:
        """Read it back."""
        storage.load_state_dict(torch.load(Path(path) / "ring.pt", weights_only=True))


class RingStorage(TensorStorage):
    """Frame rows in a ring of ``window + slack`` rows, and the valid transitions among them.

    A row holds one frame, and the transition that starts at it, if one does. A transition is valid while it
    is among the newest ``capacity`` and all its frames are among the newest ``window`` rows. So a state from
    a moment ago needs no row that was overwritten since, as long as at most ``slack`` rows were.

    Args:
        capacity: Most transitions that are valid at once.
        window: Rows that valid transitions may use.
        slack: Further rows, which only restoring needs.
        columns: Name to (shape, dtype) of every per-row quantity, ``pixels`` among them.
        frame_stack: k, frames per stack.
        root_columns: Names that belong to a transition's observation; the others are returned under ``"next"``.
        path: Directory of the memory-mapped files; RAM if ``None``.
    """

    _default_checkpointer = RingCheckpointer

    def __init__(
        self,
        capacity: int,
        *,
        window: int,
        slack: int,
        columns: Mapping[str, tuple[tuple[int, ...], torch.dtype]],
        frame_stack: int,
        root_columns: tuple[str, ...] = ("action",),
        path: Path | None = None,
    ):
        self.window, self.slack, self.frame_stack = window, slack, frame_stack
        self.rows, self.path = window + slack, path
        self.root_columns = root_columns
        self.reading = Reading()
        self.cursors = RingCursors()
        # ``number`` is one more than the row's counter, 0 if it was never written; ``row_of`` belongs to
        # transitions, which have a counter of their own.
        own = {"step": torch.int32, "number": torch.int64, "row_of": torch.int64}
        columns = {**columns, **{name: ((), dtype) for name, dtype in own.items()}}
        self._maps: list[mmap.mmap] = []
        if path is not None:
            path.mkdir(parents=True, exist_ok=True)
        leaves = {name: self._allocate(name, *spec) for name, spec in columns.items()}
        super().__init__(TensorDict(leaves, batch_size=[self.rows]))
        self.max_size = capacity

    # -- writing

    def write_first(self, values: Mapping[str, Any]) -> int:
        """Write the first frame of an episode; returns its slot."""
        self.cursors.step, self.cursors.is_open = 0, True
        return self._write_row(values)

    def write_next(self, transition: Mapping[str, Any], values: Mapping[str, Any], *, is_last: bool) -> int:
        """Write the transition from the newest frame and the frame it leads to; returns that one's slot."""
        start = self.cursors.frames - 1
        for name, value in transition.items():
            self._storage.get(name)[start % self.rows] = torch.as_tensor(value)
        self._storage.get("row_of")[self.cursors.transitions % self.rows] = start
        self.cursors.transitions += 1
        self.cursors.step += 1
        self.cursors.is_open = not is_last
        return self._write_row(values)

    def _write_row(self, values: Mapping[str, Any]) -> int:
        slot = self.cursors.frames % self.rows
        # Numbered before the row is overwritten: a kill in between must not hide the loss.
        self._storage.get("number")[slot] = self.cursors.frames + 1
        for name, value in values.items():
            self._storage.get(name)[slot] = torch.as_tensor(value)
        self._storage.get("step")[slot] = self.cursors.step
        self.cursors.frames += 1
        self._evict()
        return slot

    def _evict(self) -> None:
        cursors, oldest_row = self.cursors, self.cursors.frames - self.window
        while cursors.oldest < cursors.transitions:
            row = int(self._storage.get("row_of")[cursors.oldest % self.rows])
            first = row - min(self.frame_stack - 1, int(self._storage.get("step")[row % self.rows]))
            if first >= oldest_row and cursors.transitions - cursors.oldest <= self.max_size:
                return
            cursors.oldest += 1

    # -- reading

    def __len__(self) -> int:
        cursors = self.cursors
        return cursors.transitions - cursors.oldest

    @property
    def _len(self) -> int:
        return len(self)

    @_len.setter
    def _len(self, value: int) -> None:
        pass  # follows the cursors

    def get(self, index: Any) -> TensorDict:
        """Return the transitions at ``index``, 0 being the oldest valid one, as :attr:`reading` says."""
        if isinstance(index, tuple) and len(index) == 1:
            index = index[0]
        if isinstance(index, slice):
            positions = torch.arange(*index.indices(len(self)))
        else:
            positions = torch.as_tensor(index)
            if positions.dtype is torch.bool:
                positions = positions.nonzero().squeeze(-1)
            positions = positions.long()
            if positions.numel() and not (
                -len(self) <= int(positions.min()) and int(positions.max()) < len(self)
            ):
                raise IndexError(f"index {index} is out of range for {len(self)} transitions.")
            positions = torch.where(positions < 0, positions + len(self), positions)
        flat = positions.reshape(-1)
        n_step, discount = self.reading.n_step, self.reading.discount
        row = self._counters_at(flat) % self.rows
        # The transitions of a window follow one another in rows, and its last one leads to the next observation.
        last, following = (row + n_step - 1) % self.rows, (row + n_step) % self.rows
        batch = TensorDict({"index": flat, "row": row, ("next", "row"): following}, batch_size=flat.shape)
        for name in self._storage.keys():  # noqa: SIM118 - iterating a TensorDict yields rows
            if name in _OWN:
                continue
            is_root, column = name in self.root_columns, self._storage.get(name)
            batch.set(name if is_root else ("next", name), column[row if is_root else last])
        if discount is not None:
            window = (row.unsqueeze(-1) + torch.arange(n_step)) % self.rows
            rewards, ended = self._storage.get("reward")[window], self._storage.get("terminated")[window]
            returns, discounts = n_step_return(rewards, ended, discount)
            batch.set(("next", "reward"), returns)
            batch.set(("next", "discount"), discounts)
        if self.reading.pixels:
            batch.set("pixels", self.stacks_at(row))
            batch.set(("next", "pixels"), self.stacks_at(following))
        return batch if positions.ndim == 1 else batch.reshape(positions.shape)

    def has_window(self, index: Tensor, n_step: int) -> Tensor:
        """Whether ``n_step`` transitions from ``index`` on, ``[B]``, at most ``len - n_step``, are of one episode."""
        # An episode has one frame more than transitions, so between two of them the rows jump.
        return self._counters_at(index + n_step - 1) - self._counters_at(index) == n_step - 1

    def _counters_at(self, index: Tensor) -> Tensor:
        """Return how many frames were written before those that the transitions start at."""
        return self._storage.get("row_of")[(self.cursors.oldest + index) % self.rows]

    def stacks_at(self, slots: Tensor) -> Tensor:
        """Return the observations whose newest frames lie in ``slots``, uint8 ``[B, k * C, H, W]``."""
        rows = stack_rows(slots, self._storage.get("step")[slots], self.frame_stack) % self.rows
        return gather_stacks(self._storage.get("pixels"), rows)

    def numbers_at(self, slots: Tensor) -> Tensor:
        """Return how many frames were stored before those in ``slots``."""
        return self._storage.get("number")[slots] - 1

    def live_slots(self) -> Tensor:
        """Return the slots of all observations of valid transitions, and of the newest one, oldest first."""
        cursors = self.cursors
        number = torch.arange(cursors.oldest, cursors.transitions) % self.rows
        row = self._storage.get("row_of")[number]
        newest = [cursors.frames - 1] if cursors.frames else []
        both = torch.cat([row, row + 1, torch.tensor(newest, dtype=torch.int64)])
        return both.unique() % self.rows

    def set(self, *_: Any, **__: Any) -> None:
        """Refuse: rows depend on each other."""
        raise RuntimeError("Write a FrameReplay with begin_episode(...) and append(...).")

    # -- keeping

    def flush(self) -> None:
        """Write the memory-mapped rows to the disk; a kill of this process loses nothing even without it."""
        for mapped in self._maps:
            mapped.flush()

    def state_dict(self) -> dict[str, Any]:
        """Return the cursors, and the rows themselves if they live in RAM."""
        state: dict[str, Any] = {"cursors": asdict(self.cursors), "rows": self.rows, "window": self.window}
        if self.path is None:
            used = min(self.cursors.frames, self.rows)
            state["content"] = {name: column[:used].clone() for name, column in self._storage.items()}
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
        cursors = RingCursors(**state_dict["cursors"])
        if "content" in state_dict:
            for name, column in state_dict["content"].items():
                self._storage.get(name)[: len(column)] = column
        else:
            self._check_rows(cursors)
        self.cursors = cursors

    def _check_rows(self, cursors: RingCursors) -> None:
        """Make sure that every row of a state's window still holds what it held then."""
        needed = torch.arange(max(0, cursors.frames - self.window), cursors.frames)
        number = self._storage.get("number")
        lost = int((number[needed % self.rows] != needed + 1).sum())
        if lost:
            since = int(number.max()) - cursors.frames
            why = "the files were removed or replaced; put them back."
            if since > self.slack:
                why = (
                    f"{since} frames were written after it, with a slack of {self.slack}; begin again with a "
                )
                why += "larger one (a run has it from `checkpoint_interval_env_steps`), or use a newer checkpoint."
            raise CheckpointError(f"{lost} rows that the checkpoint of {self.path} needs are gone: {why}")

    def _empty(self) -> None:
        self.cursors = RingCursors()

    def _allocate(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        rows = self.rows
        if self.path is None:
            return torch.zeros(rows, *shape, dtype=dtype)
        size = rows * torch.Size(shape).numel() * dtype.itemsize
        mapped = map_file(self.path / f"{name}.memmap", size)
        self._maps.append(mapped)
        return torch.frombuffer(mapped, dtype=dtype).view(rows, *shape)

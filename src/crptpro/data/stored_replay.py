"""The replay that an exploring run left behind, read in the order in which it was lived."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from crptpro.data.frame_stacks import gather_stacks, map_column, stack_rows
from crptpro.data.layout import Column
from crptpro.errors import DatasetError

_CHANNELS = 3


class StoredReplay:
    """The observations in the files of a :class:`~crptpro.data.FrameReplay`, oldest first, without writing to them.

    A ring that went round holds the newest part alone; the files do not tell how much came before.

    Args:
        path: directory that was the replay's ``path``; nobody may be writing to it.
        frame_stack: k, frames per observation.

    Raises:
        DatasetError: if there is no replay of square RGB frames, or not a single transition in it.
    """

    def __init__(self, path: str | Path, *, frame_stack: int = 3) -> None:
        self.path, self.frame_stack = Path(path), frame_stack
        self.rows = self._size("number") // 8
        self._frames = self._map("pixels", "uint8", self._frame_shape())
        number, self._step = self._map("number", "int64", ()), self._map("step", "int32", ())
        # A row's number is one more than the frames written before it, 0 where none was; frames follow one another.
        written = number[number > 0] - 1
        counters = torch.arange(int(written.min()), int(written.max()) + 1) if len(written) else written
        if not torch.equal(counters, written.sort().values):
            raise DatasetError(f"{self.path} has lost rows in the middle; explore again.")
        step = self._step[counters % self.rows].long()
        # An action was taken where the same episode goes on; the oldest stacks may have lost their first frames.
        goes_on = step[1:] == step[:-1] + 1
        is_whole = counters - torch.clamp(step, max=frame_stack - 1) >= counters[:1]
        self._starts = counters[:-1][goes_on & is_whole[:-1]]
        if not len(self._starts):
            raise DatasetError(f"The replay in {self.path} has no transition.")

    def __len__(self) -> int:
        """Return how many decisions it holds."""
        return len(self._starts)

    def observations(self, index: Tensor) -> Tensor:
        """Return what was seen before decisions, uint8 ``[B, k * 3, H, W]``.

        Args:
            index: int64 ``[B]``; 0 is the oldest decision, ``len(self) - 1`` the newest.
        """
        counters = self._starts[index]
        rows = stack_rows(counters, self._step[counters % self.rows], self.frame_stack)
        return gather_stacks(self._frames, rows % self.rows)

    def _frame_shape(self) -> tuple[int, int, int]:
        pixels = self._size("pixels") // (_CHANNELS * max(self.rows, 1))
        size = math.isqrt(pixels)
        if not self.rows or _CHANNELS * size * size * self.rows != self._size("pixels"):
            raise DatasetError(f"{self.path} holds no square RGB frames; it is damaged, or no replay.")
        return (_CHANNELS, size, size)

    def _size(self, name: str) -> int:
        try:
            return self._file(name).stat().st_size
        except OSError:
            raise DatasetError(
                f"{self.path} holds no replay: {name}.memmap is missing. It is what an exploring run leaves behind; "
                "explore again if it was removed."
            ) from None

    def _map(self, name: str, dtype: str, shape: tuple[int, ...]) -> Tensor:
        return map_column(self._file(name), Column("frames", (name,), dtype, shape), self.rows)

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.memmap"

"""A TorchRL storage of transitions that keeps each frame once and rebuilds the stacks when it is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorStorage
from torchrl.data.replay_buffers.checkpointers import StorageCheckpointerBase

from crptpro.data.card import read_card
from crptpro.data.frame_stacks import gather_stacks, map_column, stack_rows
from crptpro.data.layout import FRAMES, TRANSITIONS, Layout
from crptpro.errors import DatasetError


class DatasetReference(StorageCheckpointerBase):
    """Checkpoints a read-only dataset as a reference to it: its card's identity instead of its gigabytes."""

    def dumps(self, storage: FrameStorage, path: str | Path) -> None:
        """Write which dataset this is."""
        Path(path).mkdir(parents=True, exist_ok=True)
        (Path(path) / "dataset_reference.json").write_text(json.dumps(storage.identity()))

    def loads(self, storage: FrameStorage, path: str | Path) -> None:
        """Check that the buffer being restored reads the same dataset."""
        storage.load_state_dict(json.loads((Path(path) / "dataset_reference.json").read_text()))


class FrameStorage(TensorStorage):
    """A read-only TorchRL storage over frames stored once; its length is the number of transitions.

    ``get(index)`` returns a TensorDict with ``pixels`` and ``("next", "pixels")`` uint8 ``[*, k * C, H, W]``
    (k frames, oldest to newest), every per-transition column, and so works with any TorchRL sampler::

        storage = FrameStorage.open("data/walker")
        rb = ReplayBuffer(storage=storage, sampler=RandomSampler(), batch_size=512)

    The stack of transition i is made of rows ``row[i] - min(j, step[i])``, j = k-1 .. 0, and that of its
    successor ends at ``row[i] + 1``; both lie inside the episode, because an episode of T transitions has T +
    1 frames.

    Args:
        frames: TensorDict ``[F]`` with ``pixels`` uint8 ``[F, C, H, W]`` and optional physical state.
        transitions: TensorDict ``[N]`` with ``row`` int64, ``step``, and any per-transition columns.
        frame_stack: k, frames per stack.

    Raises:
        DatasetError: for a ``frame_stack`` below 1.
    """

    _default_checkpointer = DatasetReference

    def __init__(self, frames: TensorDictBase, transitions: TensorDictBase, *, frame_stack: int = 3):
        if frame_stack < 1:
            raise DatasetError(f"frame_stack must be at least 1, got {frame_stack}.")
        super().__init__(transitions, device=frames.get("pixels").device)
        self.frames = frames
        self.frame_stack = frame_stack
        self.reads_pixels = True
        self.path: Path | None = None
        self.card: dict[str, Any] = {}

    @classmethod
    def open(
        cls, path: str | Path, *, frame_stack: int | None = None, device: str | torch.device = "cpu"
    ) -> FrameStorage:
        """Open a finished dataset; its frames stay on disk, mapped without write access.

        Args:
            path: The dataset's directory.
            frame_stack: Frames per stack; the card's (3) if ``None``.
            device: Where frames and samples live. On another device than the CPU the frames are copied there
                (2.1 GB per 100,000 transitions of 84 x 84), so that sampling needs no transfer.

        Raises:
            DatasetError: naming the file that is missing, truncated or foreign; for a ``frame_stack`` below 1.
        """
        path = Path(path).resolve()
        card = read_card(path)
        layout = Layout.from_dict(card["layout"])
        rows = {FRAMES: card["frames"], TRANSITIONS: card["transitions"]}
        parts: dict[str, TensorDict] = {
            part: TensorDict(
                {c.key: map_column(path / c.file, c, rows[part]) for c in layout.columns() if c.part == part},
                batch_size=[rows[part]],
            )
            for part in rows
        }
        # The transition columns are a few MB: in RAM, so that a sample touches the disk for pixels alone.
        transitions = parts[TRANSITIONS].clone()
        if torch.device(device).type != "cpu":
            parts[FRAMES], transitions = parts[FRAMES].to(device), transitions.to(device)
        frame_stack = card["frame_stack"] if frame_stack is None else frame_stack
        storage = cls(parts[FRAMES], transitions, frame_stack=frame_stack)
        storage.path, storage.card = path, card
        return storage

    def get(self, index: Any) -> TensorDict:
        """Return the transitions at ``index``: an int, a slice, a mask, or integers of any shape.

        Raises:
            IndexError: if an index is out of range.
        """
        positions = self._positions(index)
        flat = positions.reshape(-1)
        columns = self._storage.apply(lambda column: column.index_select(0, flat), batch_size=flat.shape)
        if self.reads_pixels:
            frames = self.frames.get("pixels")
            for key, rows in self.stack_rows_of(columns).items():
                columns.set(key, gather_stacks(frames, rows))
        return columns if positions.ndim == 1 else columns.reshape(positions.shape)

    def stack_rows_of(self, transitions: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Return the frame rows of both observations of transitions ``[B]``: int64 ``[B, k]`` by the stack's key."""
        row, step = transitions.get("row"), transitions.get("step")
        return {
            "pixels": stack_rows(row, step, self.frame_stack),
            ("next", "pixels"): stack_rows(row + 1, step + 1, self.frame_stack),
        }

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

    def set(self, *_: Any, **__: Any) -> None:
        """Refuse: the dataset is read-only."""
        raise DatasetError(f"{self.path or 'This dataset'} is read-only; collect another one to change it.")

    def _empty(self) -> None:
        self.set()

    def identity(self) -> dict[str, Any]:
        """Return what tells this dataset from another one of the same shape."""
        names = ("domain", "task", "seed", "transitions", "frames", "quality", "action_repeat", "crc32")
        return {name: self.card.get(name) for name in names} | {"frame_stack": self.frame_stack}

    def state_dict(self) -> dict[str, Any]:
        """Return :meth:`identity`: a checkpoint refers to the dataset, it does not copy it."""
        return self.identity()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Check that a checkpoint belongs to this dataset.

        Raises:
            DatasetError: if it was written with another one.
        """
        mine = self.identity()
        differing = [name for name in mine if mine[name] != state_dict.get(name)]
        if differing:
            name = differing[0]
            raise DatasetError(
                f"The checkpoint was written with another dataset: {name} was {state_dict.get(name)}, "
                f"{self.path} has {mine[name]}. Open the dataset it was written with."
            )

    def __reduce__(self) -> Any:
        # A mapped file is reopened by the receiving process instead of being sent to it.
        if self.path is None:
            return super().__reduce__()
        return _reopen, (self.path, self.frame_stack, str(self.device))

    def __repr__(self) -> str:
        where = self.path or "memory"
        return (
            f"FrameStorage({where}, transitions={len(self)}, frames={len(self.frames)}, k={self.frame_stack})"
        )


def _reopen(path: Path, frame_stack: int, device: str) -> FrameStorage:
    return FrameStorage.open(path, frame_stack=frame_stack, device=device)

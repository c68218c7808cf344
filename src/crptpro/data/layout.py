"""Where the bytes of a dataset lie: one row per frame, one per transition, in files a TensorDict can map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

FORMAT = "crptpro-frames"
VERSION = 1

CARD_FILE = "card.json"
JOURNAL_FILE = "journal.jsonl"
COLLECTION_FILE = "collection.json"
FRAMES, TRANSITIONS = "frames", "transitions"
PIXELS_FILE = f"{FRAMES}/pixels.memmap"

#: What a card says about its pixels: their type and range, unscaled.
PIXELS = "uint8 0..255"

TORCH_DTYPES = {
    "uint8": torch.uint8, "bool": torch.bool, "int32": torch.int32, "int64": torch.int64,
    "float32": torch.float32, "float64": torch.float64,
}  # fmt: skip


class Column(NamedTuple):
    """One raw little-endian file: ``rows`` rows of ``shape``, under a TensorDict key."""

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

    @property
    def torch_dtype(self) -> torch.dtype:
        """The same type for torch."""
        return TORCH_DTYPES[self.dtype]


@dataclass(frozen=True)
class Layout:
    """The shapes that fix every file of a dataset.

    Args:
        image_size: H = W, pixels.
        action_dim: Length of an action vector.
        channels: Channels of one frame.
        state: Physical quantities stored per frame as float64, name to length (``qpos``, ``qvel``).
    """

    image_size: int
    action_dim: int
    channels: int = 3
    state: Mapping[str, int] = field(default_factory=dict)

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """``[C, H, W]`` of one frame."""
        return (self.channels, self.image_size, self.image_size)

    def columns(self) -> tuple[Column, ...]:
        """Every file, frames first."""
        frame = [Column("frames", ("pixels",), "uint8", self.frame_shape)]
        frame += [Column("frames", (name,), "float64", (size,)) for name, size in sorted(self.state.items())]
        flag = "bool"
        return (
            *frame,
            Column("transitions", ("action",), "float32", (self.action_dim,)),
            Column("transitions", ("next", "reward"), "float32", (1,)),
            Column("transitions", ("next", "done"), flag, (1,)),
            Column("transitions", ("next", "terminated"), flag, (1,)),
            Column("transitions", ("next", "truncated"), flag, (1,)),
            Column("transitions", ("row",), "int64", ()),
            Column("transitions", ("step",), "int32", ()),
            Column("transitions", ("episode",), "int32", ()),
        )

    def sizes(self, transitions: int, frames: int) -> dict[str, int]:
        """Return each file's size in bytes."""
        rows = {FRAMES: frames, TRANSITIONS: transitions}
        return {column.file: column.row_bytes * rows[column.part] for column in self.columns()}

    def bytes(self, transitions: int, frames: int) -> int:
        """Return the size of the whole dataset in bytes, its card and journal excepted."""
        return sum(self.sizes(transitions, frames).values())

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form that a card holds."""
        return {
            "image_size": self.image_size,
            "action_dim": self.action_dim,
            "channels": self.channels,
            "state": dict(sorted(self.state.items())),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Layout:
        """Read what :meth:`to_dict` wrote."""
        return cls(
            image_size=int(content["image_size"]),
            action_dim=int(content["action_dim"]),
            channels=int(content["channels"]),
            state={name: int(size) for name, size in content["state"].items()},
        )


def estimate_bytes(transitions: int, image_size: int, episode_agent_steps: int | None) -> int:
    """Estimate a dataset's size before its action and state sizes are known (taken as 1 kB)."""
    episodes = -(-transitions // (episode_agent_steps or 100))
    return (transitions + episodes) * 3 * image_size**2 + transitions * 1000


def write_tensordict_metadata(root: Path, layout: Layout, transitions: int, frames: int) -> None:
    """Turn the raw files under ``root`` into two memory-mapped TensorDicts by writing their metadata."""
    from tensordict import MemoryMappedTensor, TensorDict

    for part, rows in ((FRAMES, frames), (TRANSITIONS, transitions)):
        leaves = {
            column.key: MemoryMappedTensor.from_filename(
                root / column.file, column.torch_dtype, torch.Size((rows, *column.shape))
            )
            for column in layout.columns()
            if column.part == part
        }
        # memmap_ keeps a file that already lies where it would write it, so this adds the metadata only.
        TensorDict(leaves, batch_size=[rows]).memmap_(root / part)

"""Frames of a dataset that were drawn again in other colours, kept so that they need not be drawn twice."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from crptpro.artifact import read_artifact, write_artifact
from crptpro.colors import Colors
from crptpro.errors import DatasetError

FORMAT, VERSION = "crptpro-drawn-frames", 1


@dataclass(frozen=True)
class DrawnFrames:
    """Some frames of one dataset in other colours, see :func:`~crptpro.data.redraw.redraw`.

    Args:
        domain: of the dataset.
        colors: that the frames have.
        rows: int64 ``[N]``, frame rows of the dataset, ascending, each once.
        frames: uint8 ``[N, C, H, W]``.
    """

    domain: str
    colors: Colors
    rows: Tensor
    frames: Tensor

    def __post_init__(self) -> None:
        """Refuse rows that :meth:`at` could not find."""
        if len(self.rows) != len(self.frames):
            raise ValueError(f"There are {len(self.rows)} rows for {len(self.frames)} frames.")
        if len(self.rows) > 1 and not (self.rows.diff() > 0).all():
            raise ValueError("The rows must ascend, each once.")

    def have(self, rows: Tensor) -> Tensor:
        """Return which rows ``[M]`` are among these, as bool ``[M]``."""
        return torch.isin(rows, self.rows)

    def at(self, rows: Tensor) -> Tensor:
        """Return the frames uint8 ``[M, C, H, W]`` of rows ``[M]``, all of which must be among these."""
        return self.frames[torch.searchsorted(self.rows, rows)]

    def save(self, path: str | Path) -> Path:
        """Write a directory, whole or not at all.

        Args:
            path: to write or replace.

        Raises:
            DiskSpaceError: if the disk is full; frames there are kept.
        """
        about = {"domain": self.domain, "colors": self.colors, "count": len(self.rows)}
        content = {"drawn": {"rows": self.rows, "frames": self.frames}}
        return write_artifact(path, content, card=about, format_name=FORMAT, version=VERSION)

    @classmethod
    def load(cls, path: str | Path) -> DrawnFrames:
        """Read what :meth:`save` wrote.

        Raises:
            DatasetError: naming what is missing, damaged, of another kind or too new.
        """
        card, tensors = read_artifact(path, format_name=FORMAT, version=VERSION, error=DatasetError)
        colors = cast(Colors, card["colors"])
        return cls(card["domain"], colors, tensors["drawn.rows"], tensors["drawn.frames"])

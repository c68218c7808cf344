"""A collected dataset as a TorchRL replay buffer that is only read."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, RandomSampler, ReplayBuffer

from crptpro.data.episode_writer import read_journal
from crptpro.data.frame_stacks import gather_stacks, stack_rows
from crptpro.data.frame_storage import FrameStorage
from crptpro.data.layout import JOURNAL_FILE, Layout
from crptpro.errors import DatasetError


class FrameDataset(ReplayBuffer):
    """The random-policy frames of one domain, sampled as pairs of consecutive stacks (x_t, x_t+1).

    ``sample(B)`` draws uniformly, with replacement, from all transitions and returns a TensorDict ``[B]``
    with ``pixels`` and ``("next", "pixels")`` uint8 ``[B, 3k, H, W]`` (oldest to newest, equal to what a live
    frame stack showed, episode starts included), ``action`` float32 ``[B, A]``, ``("next", "reward")``
    float32 ``[B, 1]``, ``("next", "done" | "terminated" | "truncated")`` bool ``[B, 1]``, and ``row``,
    ``step``, ``episode``: the frame row, the position in the episode and the episode's index. A pair never
    crosses an episode.

    Frames are mapped from disk without write access, so several processes can open one dataset at once.

    Args:
        storage: What to read, see :class:`~crptpro.data.FrameStorage`.
        batch_size: Default of ``sample()``.
        generator: Source of randomness; torch's global generator if ``None``.
        **kwargs: Further arguments of TorchRL's ``ReplayBuffer`` (``prefetch``, ``transform``, ``sampler``,
            ...). Prefetching threads may hand out the batches of one generator in another order.
    """

    def __init__(
        self,
        storage: FrameStorage,
        *,
        batch_size: int | None = None,
        generator: torch.Generator | None = None,
        **kwargs: Any,
    ):
        kwargs.setdefault("sampler", RandomSampler())
        self._is_plain = not kwargs.get("prefetch") and kwargs.get("collate_fn") is None
        super().__init__(
            storage=storage,
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            generator=generator,
            **kwargs,
        )

    @classmethod
    def open(
        cls,
        path: str | Path,
        batch_size: int | None = None,
        *,
        frame_stack: int | None = None,
        device: str | torch.device = "cpu",
        **kwargs: Any,
    ) -> FrameDataset:
        """Open a dataset that :func:`~crptpro.data.collect_random` made.

        Args:
            path: Its directory.
            batch_size: Default of ``sample()``.
            frame_stack: Frames per stack; the card's (3) if ``None``.
            device: ``"cpu"`` maps the frames from disk; another device holds a copy of them and samples
                there. It needs a generator of the same device.
            **kwargs: See the class.

        Raises:
            DatasetError: naming the file that is missing, unfinished, truncated or foreign.
        """
        storage = FrameStorage.open(path, frame_stack=frame_stack, device=device)
        return cls(storage, batch_size=batch_size, **kwargs)

    def sample(
        self, batch_size: int | None = None, return_info: bool = False, *, pixels: bool = True
    ) -> TensorDictBase:
        """Draw transitions uniformly with replacement; see the class.

        Args:
            batch_size: B.
            return_info: as in TorchRL's ``ReplayBuffer``.
            pixels: ``False`` leaves the stacks out, for who reads them from :attr:`frames` (see
                :meth:`stack_rows_of`); only where :attr:`is_read_directly`.

        Raises:
            ValueError: if something else takes part in reading that may want the stacks.
        """
        if not pixels and not self.is_read_directly:
            raise ValueError(
                "A dataset that prefetches, transforms or collates in its own way cannot leave the pixels out."
            )
        self._storage.reads_pixels = pixels
        try:
            return super().sample(batch_size, return_info)
        finally:
            self._storage.reads_pixels = True

    @property
    def is_read_directly(self) -> bool:
        """Whether a sample is what the storage returns: no transform, no prefetching, no collation of its own."""
        return self._is_plain and not len(self._transform)

    def stack_rows_of(self, transitions: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Return which rows of :attr:`frames` make up the observations of sampled transitions.

        Args:
            transitions: a sample ``[B]``, with or without pixels.

        Returns:
            int64 ``[B, k]``, oldest to newest, for ``"pixels"`` and for ``("next", "pixels")``.
        """
        return self._storage.stack_rows_of(transitions)

    @property
    def card(self) -> dict[str, Any]:
        """The dataset's card; empty for a storage built in memory."""
        return self._storage.card

    @property
    def path(self) -> Path | None:
        """The dataset's directory."""
        return self._storage.path

    @property
    def domain(self) -> str:
        """The domain's name."""
        return self.card.get("domain", "unknown")

    @property
    def frame_stack(self) -> int:
        """Frames per stack."""
        return self._storage.frame_stack

    @property
    def frames(self) -> TensorDictBase:
        """All frame rows, TensorDict ``[F]``: ``pixels`` uint8 ``[F, C, H, W]``, ``qpos`` and ``qvel``."""
        return self._storage.frames

    @property
    def transitions(self) -> TensorDictBase:
        """All transition rows without pixels, TensorDict ``[N]``."""
        return self._storage._storage

    def frames_at(self, rows: Tensor) -> Tensor:
        """Return single frames, uint8 ``[*, C, H, W]``, at frame rows of any shape."""
        frames = self.frames.get("pixels")
        rows = torch.as_tensor(rows, device=frames.device)
        return gather_stacks(frames, rows.reshape(-1, 1)).view(*rows.shape, *frames.shape[1:])

    def physics_at(self, rows: Tensor) -> TensorDict:
        """Return the physical state at frame rows of any shape.

        Returns:
            TensorDict ``[*]`` of float64 ``qpos`` ``[*, nq]`` and ``qvel`` ``[*, nv]``.

        Raises:
            DatasetError: if the domain has no physical state.
        """
        state = self.frames.exclude("pixels")
        if state.is_empty():
            raise DatasetError(f"The dataset of {self.domain!r} stores no physical state (qpos, qvel).")
        rows = torch.as_tensor(rows, device=state.get(next(iter(state.keys()))).device)
        return state.apply(lambda column: column[rows], batch_size=rows.shape)

    def episode_stacks(self, episode: int) -> Tensor:
        """Return every observation of one episode in order, uint8 ``[T + 1, k * C, H, W]``."""
        inside = (self.transitions.get("episode") == episode).nonzero().squeeze(-1)
        if not len(inside):
            raise DatasetError(f"{self.domain!r} has no episode {episode}.")
        step = torch.arange(len(inside) + 1, device=inside.device)
        rows = stack_rows(self.transitions.get("row")[inside[0]] + step, step, self.frame_stack)
        return gather_stacks(self.frames.get("pixels"), rows)

    def verify(self) -> None:
        """Read every byte and compare it with the checksums written at collection (2 GB take some seconds).

        Raises:
            DatasetError: naming the first damaged episode.
        """
        if self.path is None:
            raise DatasetError("Only a dataset on disk can be verified; this one was built in memory.")
        layout = Layout.from_dict(self.card["layout"])
        entries = read_journal(self.path / JOURNAL_FILE)
        if sum(entry.transitions for entry in entries) != len(self):
            raise DatasetError(f"{self.path / JOURNAL_FILE} does not cover the dataset; collect it again.")
        files = {column.file: os.open(self.path / column.file, os.O_RDONLY) for column in layout.columns()}
        try:
            for entry in entries:
                checksum = 0
                for column in layout.columns():
                    rows = entry.frames if column.part == "frames" else entry.transitions
                    checksum = zlib.crc32(os.read(files[column.file], rows * column.row_bytes), checksum)
                if checksum != entry.crc32:
                    raise DatasetError(
                        f"Episode {entry.episode} of {self.path} is damaged. Collect the dataset again."
                    )
        finally:
            for file in files.values():
                os.close(file)

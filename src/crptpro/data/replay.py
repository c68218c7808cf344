"""The replay buffer of downstream learning: an online ring in which each frame is stored once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer

from crptpro.cards import require_disk
from crptpro.data.n_step import Reading, WindowSampler
from crptpro.data.ring_storage import RingStorage

# Names in the ring or in a sample; the arguments of append() are among them, next_frame apart.
_TAKEN = {
    *("pixels", "action", "reward", "done", "terminated", "truncated", "discount"),
    *("index", "row", "row_of", "step", "number", "next", "next_frame"),
}


class _EpisodeOnlyWriter(ImmutableDatasetWriter):
    """Refuses ``add`` and ``extend``: a frame belongs to the episode it came in."""

    WRITING_ERR = "Write a FrameReplay with begin_episode(...) and append(...), not with add or extend."

    def _empty(self, empty_write_count: bool = True) -> None:
        pass


class FrameReplay(ReplayBuffer):
    """Online replay of transitions whose frames are stored once, in RAM or on disk.

    40,000 transitions of 84 x 84 frames take 0.85 GB instead of the 5.1 GB of stored stacks. Transitions
    leave first in, first out. A sampled pair never crosses an episode nor the place where the ring is being
    overwritten.

    A ring on disk is its own checkpoint: :meth:`state_dict` holds a few counters, and loading one restores
    exactly the content of its moment, provided that at most ``slack`` frames were written since. With
    checkpoints every n transitions, of which the last two are kept, ``slack >= 2 * n`` (plus a frame per
    episode) is enough.

    Args:
        capacity: Most transitions that can be sampled. Very short episodes (below 50 transitions) lower it,
            because each has one frame more than transitions.
        frame_shape: ``(C, H, W)`` of a single frame.
        action_dim: A, length of an action.
        path: Directory of the ring's files; RAM if ``None``. It must not be shared by two running buffers.
        slack: Frames that may be written after a checkpoint before it is worthless; 0 if there are none.
        frame_stack: k, frames per stack.
        extra_columns: Further quantities per transition, such as the skill that chose the action: name to
            ``(shape, dtype)``. Given to :meth:`append` as keyword arguments, sampled under their names.
        batch_size: Default of :meth:`sample`.
        generator: Source of randomness; torch's global generator if ``None``.

    Raises:
        DiskSpaceError: if the disk cannot hold the ring.
        CheckpointError: if ``path`` holds a ring of another size.
        ValueError: if an extra column has the name of something that a sample has anyway.

    Examples:
        >>> replay = FrameReplay(capacity=100, frame_shape=(3, 4, 4), action_dim=1)
        >>> frame = torch.zeros(3, 4, 4, dtype=torch.uint8)
        >>> slot = replay.begin_episode(frame)
        >>> slot = replay.append(torch.zeros(1), 1.0, False, False, frame + 1)
        >>> replay.sample(2)["next", "pixels"].shape
        torch.Size([2, 9, 4, 4])
    """

    def __init__(
        self,
        capacity: int,
        *,
        frame_shape: tuple[int, int, int] = (3, 84, 84),
        action_dim: int,
        path: str | Path | None = None,
        slack: int = 0,
        frame_stack: int = 3,
        extra_columns: Mapping[str, tuple[tuple[int, ...], torch.dtype]] | None = None,
        batch_size: int | None = None,
        generator: torch.Generator | None = None,
    ):
        if capacity < 1 or slack < 0:
            raise ValueError(f"capacity must be at least 1 and slack at least 0, got {capacity} and {slack}.")
        # One frame more per episode than transitions, and the frames of the oldest stack.
        window = capacity + max(16, capacity // 50) + frame_stack
        extra = dict(extra_columns or {})
        taken = sorted(_TAKEN & set(extra))
        if taken:
            raise ValueError(
                f"extra_columns may not be named {taken}: a sample has those; choose other names."
            )
        columns: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "pixels": (tuple(frame_shape), torch.uint8),
            "action": ((action_dim,), torch.float32),
            "reward": ((1,), torch.float32),
            "done": ((1,), torch.bool),
            "terminated": ((1,), torch.bool),
            "truncated": ((1,), torch.bool),
            **extra,
        }
        self._extra = tuple(extra)
        self._frame_shape = torch.Size(frame_shape)
        if path is not None and not (Path(path) / "pixels.memmap").exists():
            row_bytes = sum(torch.Size(shape).numel() * dtype.itemsize for shape, dtype in columns.values())
            require_disk(path, (window + slack) * row_bytes, f"A replay of {capacity} transitions")
        storage = RingStorage(
            capacity,
            window=window,
            slack=slack,
            columns=columns,
            frame_stack=frame_stack,
            root_columns=("action", *extra),
            path=None if path is None else Path(path),
        )
        super().__init__(
            storage=storage,
            sampler=WindowSampler(),
            writer=_EpisodeOnlyWriter(),
            batch_size=batch_size,
            generator=generator,
        )

    @property
    def capacity(self) -> int:
        """Most transitions that can be sampled."""
        return self._storage.max_size

    @property
    def frame_slots(self) -> int:
        """Number of frame rows; every slot that is returned or sampled lies in ``[0, frame_slots)``."""
        return self._storage.rows

    @property
    def window(self) -> int:
        """Rows that sampled transitions and the newest observation lie in; at most ``frame_slots``."""
        return self._storage.window

    @property
    def slack(self) -> int:
        """Frames that may be written after a checkpoint before it is worthless."""
        return self._storage.slack

    @property
    def frames_written(self) -> int:
        """Frames stored so far, those that were overwritten included."""
        return self._storage.cursors.frames

    def numbers_at(self, slots: Tensor) -> Tensor:
        """Return how many frames were stored before those in ``slots``, int64 ``[B]``.

        Unlike slots, numbers are never used again; those of live observations differ modulo :attr:`window`.
        """
        return self._storage.numbers_at(slots)

    def begin_episode(self, frame: Tensor) -> int:
        """Store the first frame of an episode, whether or not the previous one had ended.

        Args:
            frame: uint8 ``[C, H, W]``, the single newest frame.

        Returns:
            The frame's slot, which identifies this observation while it is in the ring.
        """
        return self._storage.write_first(self._row(frame))

    def append(
        self,
        action: Tensor,
        reward: float | Tensor,
        terminated: bool | Tensor,
        truncated: bool | Tensor,
        next_frame: Tensor,
        **columns: Any,
    ) -> int:
        """Store a transition from the newest observation, and the frame it leads to.

        Args:
            action: float ``[A]``.
            reward: Its reward.
            terminated: The episode ended by its own rules; it is not bootstrapped.
            truncated: The episode was stopped, by a time limit for example; it is bootstrapped.
            next_frame: uint8 ``[C, H, W]``, the single newest frame.
            **columns: The ``extra_columns`` of this transition.

        Returns:
            The next frame's slot.

        Raises:
            RuntimeError: if no episode is running.
            ValueError: if an extra column is missing or unknown.
        """
        if not self._storage.cursors.is_open:
            raise RuntimeError("No episode is running: call begin_episode(frame) with its first frame.")
        if set(columns) != set(self._extra):
            raise ValueError(f"Every transition needs {sorted(self._extra)}, got {sorted(columns)}.")
        terminated, truncated = bool(terminated), bool(truncated)
        transition = {
            "action": action,
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated or truncated,
            **columns,
        }
        is_last = terminated or truncated
        return self._storage.write_next(transition, self._row(next_frame), is_last=is_last)

    def sample(
        self,
        batch_size: int | None = None,
        return_info: bool = False,
        *,
        pixels: bool = True,
        n_step: int = 1,
        discount: float | None = None,
    ) -> TensorDict:
        """Draw uniformly, with replacement, from the valid transitions.

        For ``n_step`` above 1, only those are drawn from whose n transitions lie in one episode and in the ring;
        as in url_benchmark (``replay_buffer.py``), a window is not cut short at an episode's end, so an episode's
        last n - 1 transitions are only ever the later part of one. ``("next", ...)`` is then n agent steps ahead:
        its flags are the last transition's, its reward is the n-step return, and ``("next", "discount")`` weighs
        the value of the next observation (:func:`~crptpro.data.n_step.n_step_return`).

        Deviation: url_benchmark draws an episode uniformly and then an anchor in it, and only from finished
        episodes; here every admissible anchor is equally likely, the running episode's included. For finished
        episodes of equal length the two are the same.

        Args:
            batch_size: B; the constructor's if ``None``.
            return_info: As in TorchRL: return ``(batch, info)``.
            pixels: False leaves the frames unread, for a user that has features by slot.
            n_step: n, agent steps from an observation to the next one.
            discount: gamma of the n-step return. None is 0.99; for ``n_step`` 1 it leaves
                ``("next", "discount")`` out.

        Returns:
            TensorDict ``[B]``: ``pixels`` and ``("next", "pixels")`` uint8 ``[B, k * C, H, W]``, ``action``,
            the ``extra_columns``, ``("next", "reward" | "done" | "terminated" | "truncated")`` ``[B, 1]``,
            ``("next", "discount")`` float32 ``[B, 1]``, ``index`` (0 is the oldest valid transition), ``row``
            and ``("next", "row")``: the slots of the two observations' newest frames.

        Raises:
            RuntimeError: if there is nothing to draw from.
            ValueError: if ``n_step`` is below 1.
        """
        if n_step < 1:
            raise ValueError(f"n_step must be at least 1, got {n_step}.")
        if discount is None and n_step > 1:
            discount = 0.99
        self._storage.reading = Reading(pixels, n_step, discount)
        try:
            return super().sample(batch_size, return_info)
        finally:
            self._storage.reading = Reading()

    def observations_at(self, slots: Tensor) -> Tensor:
        """Return the observations whose newest frames lie in ``slots``, uint8 ``[B, k * C, H, W]``."""
        return self._storage.stacks_at(slots)

    def live_slots(self) -> Tensor:
        """Return the slots of the observations that a sample can refer to and of the newest, oldest first."""
        return self._storage.live_slots()

    def flush(self) -> None:
        """Write a ring on disk through to it; only a crash of the machine makes a difference."""
        self._storage.flush()

    def state_dict(self) -> dict[str, Any]:
        """Return a few counters (ring on disk) or the whole content (ring in RAM)."""
        self.flush()
        return {"ring": self._storage.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the content of the moment the state was taken; the generator's state is the caller's.

        Raises:
            CheckpointError: if the ring has another size, or was overwritten by more than ``slack`` frames
                since.
        """
        self._storage.load_state_dict(state_dict["ring"])

    def _row(self, frame: Tensor) -> dict[str, Any]:
        frame = torch.as_tensor(frame)
        if frame.dtype != torch.uint8 or frame.shape != self._frame_shape:
            raise ValueError(
                f"A frame must be uint8 {tuple(self._frame_shape)}, the newest single frame, "
                f"got {frame.dtype} {tuple(frame.shape)}."
            )
        return {"pixels": frame}

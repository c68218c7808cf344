"""One episode in memory: T transitions between T + 1 frames, as plain arrays that any process can send."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from crptpro.data.layout import Layout


@dataclass(frozen=True)
class Episode:
    """An episode of T transitions.

    Args:
        pixels: uint8 ``[T + 1, C, H, W]``, single frames.
        action: float32 ``[T, A]``.
        reward: float32 ``[T]``.
        terminated: bool ``[T]``.
        truncated: bool ``[T]``.
        state: float64 ``[T + 1, n]`` each, by name.
        is_cut: It was stopped before the environment ended it.
    """

    pixels: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    state: Mapping[str, np.ndarray] = field(default_factory=dict)
    is_cut: bool = False

    def __len__(self) -> int:
        return len(self.action)

    @property
    def layout(self) -> Layout:
        """The shapes of this episode's rows."""
        return Layout(
            image_size=self.pixels.shape[-1],
            action_dim=self.action.shape[-1],
            channels=self.pixels.shape[1],
            state={name: values.shape[-1] for name, values in self.state.items()},
        )

    def cut(self, transitions: int) -> Episode:
        """Return the first ``transitions`` of it, the last of them marked truncated unless it terminates."""
        if transitions >= len(self):
            return self
        if transitions < 1:
            raise ValueError(f"An episode needs at least one transition, got {transitions}.")
        truncated = self.truncated[:transitions].copy()
        truncated[-1] = not self.terminated[transitions - 1]
        return replace(
            self,
            pixels=self.pixels[: transitions + 1],
            action=self.action[:transitions],
            reward=self.reward[:transitions],
            terminated=self.terminated[:transitions],
            truncated=truncated,
            state={name: values[: transitions + 1] for name, values in self.state.items()},
            is_cut=True,
        )

    def rows(self, *, episode: int, first_row: int) -> dict[tuple[str, ...], np.ndarray]:
        """Return the rows this episode adds to each column, given its index and its first frame's row."""
        step = np.arange(len(self), dtype=np.int32)
        return {
            ("pixels",): self.pixels,
            **{(name,): values for name, values in self.state.items()},
            ("action",): self.action,
            ("next", "reward"): self.reward,
            ("next", "done"): self.terminated | self.truncated,
            ("next", "terminated"): self.terminated,
            ("next", "truncated"): self.truncated,
            ("row",): first_row + step.astype(np.int64),
            ("step",): step,
            ("episode",): np.full(len(self), episode, dtype=np.int32),
        }

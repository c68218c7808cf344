"""The replay buffer of online learning: a ring buffer in which each frame is stored once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, PrioritizedSampler, RandomSampler

from crptpro.data.storage import RingStorage, StackBuffer, StackStorage, map_rows, read_rows, stack_rows
from crptpro.errors import DatasetError
from crptpro.values import as_int, as_path


class FrameReplay(StackBuffer):
    """TorchRL replay buffer whose frames are stored once, in RAM or on disk.

    40,000 transitions of 84 x 84 frames take 0.85 GB instead of the 5.1 GB of stored stacks. It takes what TorchRL
    environments and collectors return and is first in, first out::

        replay = FrameReplay(40_000, action_dim=6, transform=RandomShift(pad=4, in_keys=[...]))
        for rollout in Collector(env, policy, frames_per_batch=100, total_frames=-1):
            replay.extend(rollout)
            batch = replay.sample(512)

    :meth:`extend` and :meth:`add` take transitions of **one** environment in temporal order, ``[T]`` or ``[]``:
    ``pixels`` and ``("next", "pixels")`` uint8 (stacks of ``frame_stack`` frames, or single ones), ``action``,
    ``("next", "reward" | "done" | "terminated" | "truncated")`` and the ``extra_columns``. A transition continues the
    one before if that one was not done and led to its observation; otherwise it begins an episode. They return the
    observations' numbers. Rollouts ``[N, T]`` of several environments are stored by ``extend(rollout.reshape(-1))``:
    each begins an episode, which costs up to ``frame_stack`` further frames, so that T should not be small.

    A sample ``[B]`` is drawn uniformly, with replacement, and has

    - ``pixels`` and ``("next", "pixels")``, uint8 ``[B, frame_stack * C, H, W]``, as of a live frame stack; a pair
      never crosses an episode nor the place where the ring is being overwritten;
    - ``action``, the ``extra_columns``, ``("next", "reward" | "done" | "terminated" | "truncated")`` ``[B, 1]``;
    - ``index`` (0 is the oldest transition) and ``number``, ``("next", "number")``, int64 ``[B]``: how many frames were
      stored before the observation's newest one. A number is never used again; :meth:`observations` reads it;
    - ``episode``, int64 ``[B]``, equal within an episode and greater in later ones, for TorchRL's ``SliceSampler``.

    With ``n_step`` above 1 only windows of n transitions are drawn that are in one episode and in the ring; none is cut
    short. ``("next", ...)`` is then n agent steps ahead, with the last transition's flags; the reward is the sum of
    gamma^i times the i-th reward, i from 0. ``steps_to_next_obs`` ``[B, 1]`` is n, as of TorchRL's
    ``MultiStepTransform``. Indexing reads single transitions.
    Deviation: url_benchmark draws an episode uniformly, and then an anchor in it; here every anchor is equally likely.

    A ring on disk is its own checkpoint: :meth:`state_dict` holds a few counters, and loading it restores the content,
    if at most ``slack`` frames were written since. With checkpoints every n transitions, ``2 * n`` (plus a frame per
    episode) suffice for the last two. Copies and pickles hold their frames in RAM. Threads may share one buffer.

    Args:
        capacity: most transitions that can be sampled; episodes below 50 transitions lower it, for their extra frame.
        frame_shape: ``(C, H, W)`` of a single frame.
        action_dim: A, length of an action.
        path: directory of the ring's files, for this buffer alone; RAM if ``None``.
        slack: frames that may be written after a checkpoint that can still be restored.
        frame_stack: frames per stack.
        extra_columns: further entries of a transition's root, such as a skill: name to ``(shape, dtype)``.
        n_step: n, agent steps from an observation to the next one of a sample.
        discount: gamma of the n-step return.
        returns_pixels: ``False`` leaves the stacks out of samples, for a transform that looks up features by number.
        **options: of TorchRL's ``ReplayBuffer``: ``batch_size``, ``generator``, ``transform``.

    Raises:
        DiskSpaceError: the disk cannot hold the ring.
        CheckpointError: ``path`` holds a ring of another size.
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
        n_step: int = 1,
        discount: float = 0.99,
        returns_pixels: bool = True,
        **options: Any,
    ):
        columns: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "pixels": (tuple(as_int(size, "frame_shape", minimum=1) for size in frame_shape), torch.uint8),
            "action": ((as_int(action_dim, "action_dim", minimum=1),), torch.float32),
            "reward": ((1,), torch.float32),
            **dict.fromkeys(("done", "terminated", "truncated"), ((1,), torch.bool)),
        }
        extra = dict(extra_columns or {})
        own = {"branch", "episode", "index", "next", "number", "row_of", "step", "steps_to_next_obs"}
        if taken := sorted({*columns, *own} & extra.keys()):
            raise ValueError(f"extra_columns may not be named {taken}: a sample has those; choose other names.")
        if "sampler" in options and n_step > 1:
            raise ValueError("With n_step above 1 a FrameReplay has its own sampler; leave out `sampler`.")
        if isinstance(options.get("sampler"), PrioritizedSampler):
            raise ValueError("A FrameReplay keeps no priorities: the index of a transition changes as others leave.")
        storage = RingStorage(
            capacity, columns | extra, slack=slack, frame_stack=frame_stack, n_step=n_step, discount=discount, path=path
        )
        storage.returns_pixels = bool(returns_pixels)
        parts = {"sampler": _WindowSampler(), "writer": _RingWriter(extra), "collate_fn": as_it_is}
        super().__init__(storage=storage, **parts | options)

    @property
    def window(self) -> int:
        """Frames that span the newest observation and all that can be sampled; their numbers differ modulo this."""
        return self._storage.window

    @property
    def frames_written(self) -> int:
        """Frames stored so far, overwritten ones included; the newest one's number is one less."""
        return self._storage.frames

    def observations(self, numbers: Tensor) -> Tensor:
        """Return observations by number, int64 ``[B]``, as uint8 ``[B, frame_stack * C, H, W]``."""
        with self._replay_lock:
            return self._storage.observations(numbers)

    def _sample(self, batch_size: int) -> tuple[Any, dict]:
        with self._replay_lock:  # a transform may read observations by number: none is overwritten meanwhile
            return super()._sample(batch_size)

    def dumps(self, path: str | Path) -> None:
        """Save the content, or the counters of a ring on disk, for :meth:`loads`, also on a machine with other GPUs."""
        super().dumps(path)
        if (file := Path(path) / "transform.t").exists():
            state = self._transform.state_dict().items()
            torch.save({name: value.cpu() if isinstance(value, Tensor) else value for name, value in state}, file)

    def loads(self, path: str | Path) -> None:
        """Restore what TorchRL's ``dumps`` wrote."""
        super().loads(path)
        self._transform.load_state_dict(self._transform.state_dict())  # drops features of the earlier numbers

    def share(self, shared: bool = True) -> FrameReplay:
        """Refuse to be shared: other processes would fill copies of it."""
        if shared:
            raise DatasetError("A FrameReplay belongs to one process: extend it with what the collector yields.")
        return super().share(False)


class StoredReplay(StackStorage):
    """The observations in the files of a :class:`FrameReplay`, oldest first, read-only.

    ``path`` is the replay's directory, which no process may be writing to. Without a replay of square RGB frames, or
    without a transition in it, a DatasetError is raised.
    """

    def __init__(self, path: str | Path, *, frame_stack: int = 3) -> None:
        path = as_path(path)
        self.frame_stack = frame_stack = as_int(frame_stack, "frame_stack", minimum=1)
        number = map_rows(path / "number.memmap", torch.int64, ())
        rows = len(number)
        row_of = map_rows(path / "row_of.memmap", torch.int64, (), rows)
        self.step = map_rows(path / "step.memmap", torch.int32, (), rows)
        size = math.isqrt(len(map_rows(path / "pixels.memmap", torch.uint8, ())) // (3 * rows))
        self.pixels = map_rows(path / "pixels.memmap", torch.uint8, (3, size, size), rows)
        # `number` counts from 1. `row_of` is 0 where never written, and before `oldest` for overwritten transitions.
        end = int(number.max())
        oldest = max(0, end - rows)
        starts = torch.cat([row_of[:1], row_of[row_of > 0]]).unique()
        starts = starts[(starts >= oldest) & (starts + 1 < end)]
        starts = starts[starts - self.step[starts % rows].clamp(max=frame_stack - 1) >= oldest]
        # After a checkpoint was loaded, rows that are not overwritten yet belong to an abandoned branch.
        held = stack_rows(starts, self.step[starts % rows], frame_stack)
        self._starts = starts[(number[held % rows] == held + 1).all(1)]
        if not len(self._starts):
            raise DatasetError(f"The replay in {path} has no transition.")
        super().__init__(len(self._starts))

    def observations(self, numbers: Tensor) -> Tensor:
        """Return the observations of transitions ``[B]``, 0 being the oldest, uint8 ``[B, k * 3, H, W]``."""
        return self._stacks(self._starts[numbers])


def as_it_is(sample: TensorDictBase) -> TensorDictBase:
    """Collate nothing: a storage of frames returns whole batches."""
    return sample


class _RingWriter(ImmutableDatasetWriter):
    """Checks transitions and writes them to the ring: about 0.25 ms for a single one."""

    def __init__(self, extra: Mapping[str, tuple[tuple[int, ...], torch.dtype]]):
        super().__init__()
        self._extra = tuple(extra)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Store transitions in temporal order; see :class:`FrameReplay`."""
        ring: RingStorage = self._storage
        channels = ring.pixels.shape[1]
        rows = read_rows(data, channels=channels, frame_stack=ring.frame_stack, extra=self._extra, what="A replay")
        for name, values in {"pixels": rows.following, **rows.columns}.items():
            if values.shape[1:] != ring.content[name].shape[1:]:
                expected, got = tuple(ring.content[name].shape[1:]), tuple(values.shape[1:])
                raise ValueError(f"This replay holds {name} of shape {expected}, got {got}.")
        return ring.write(rows)

    add = extend

    @property
    def _write_count(self) -> int:  # which TorchRL's collectors read
        return self._storage.transitions

    def _empty(self, empty_write_count: bool = True) -> None:
        pass


class _WindowSampler(RandomSampler):
    """Draws uniformly, with replacement, from the transitions whose window of n is in one episode."""

    def sample(self, storage: RingStorage, batch_size: int) -> tuple[Tensor, dict]:
        if storage.n_step == 1 or not len(storage):
            return super().sample(storage, batch_size)
        starts = storage.window_starts()
        if not len(starts):
            raise DatasetError(
                f"None of the replay's {len(storage)} transitions is followed by enough of its episode for "
                f"n_step={storage.n_step}: use a smaller n_step, or store more before the first update "
                "(random_agent_steps)."
            )
        return starts[torch.randint(len(starts), (batch_size,), generator=self._rng, device="cpu")], {}

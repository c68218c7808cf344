"""The frames of one domain on disk: written episode by episode, read as a TorchRL replay buffer."""

from __future__ import annotations

import itertools
import json
import logging
import os
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, RandomSampler, ReplayBuffer
from torchrl.envs.transforms import Transform

from crptpro.artifact import read_json, write_json
from crptpro.data.replay import as_it_is
from crptpro.data.storage import (
    CARD_FILE,
    COLLECTION_FILE,
    FORMAT,
    FRAMES,
    JOURNAL_FILE,
    PIXELS,
    VERSION,
    FrameStorage,
    Layout,
    Rows,
    gather_stacks,
    map_parts,
    read_rows,
    size_problem,
    write_tensordict_metadata,
)
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import DatasetError, DiskSpaceError, is_disk_full
from crptpro.provenance import provenance, versions
from crptpro.values import as_int, as_path

logger = logging.getLogger(__name__)

_COUNTS = ("transitions", "frames", "episodes", "frame_stack", "action_repeat", "seed")
_ABOUT = {"seed": 0, "action_repeat": 1, "camera": None, "quality": "exact", "colors": "normal"}
_TEMPORARY = f".{COLLECTION_FILE}."


class FrameDataset(ReplayBuffer):
    """The frames of one domain, sampled as pairs of consecutive stacks (x_t, x_t+1).

    ``sample(B)`` draws uniformly, with replacement, from all transitions and returns a TensorDict ``[B]`` with
    ``pixels`` and ``("next", "pixels")`` uint8 ``[B, 3k, H, W]`` (oldest to newest, equal to what a live frame stack
    showed, episode starts included), ``action`` float32 ``[B, A]``, ``("next", "reward")`` float32 ``[B, 1]``,
    ``("next", "done" | "terminated" | "truncated")`` bool ``[B, 1]``, ``index``, the position in the ``episode``
    (``step``), and ``number``, ``("next", "number")``: the rows of the observations' newest frames, which
    :meth:`observations` reads. A pair never crosses an episode.

    Frames are mapped from disk without write access, so several processes can open one dataset at once, and threads may
    sample one object.

    :meth:`open` reads a finished dataset; :meth:`create` begins one, or continues it, and :meth:`extend` fills it with
    what a random policy, or any other, does::

        dataset = FrameDataset.create("data/mine", domain="mine", transitions=10_000)
        for rollout in Collector(env, RandomPolicy(env.full_action_spec), frames_per_batch=100, total_frames=-1):
            dataset.extend(rollout)
            if dataset.is_complete:
                break

    Args:
        storage: what to read.
        batch_size: default of ``sample()``.
        generator: source of randomness; torch's global generator if ``None``.
        transform: of samples, as in TorchRL.
        **kwargs: further arguments of TorchRL's ``ReplayBuffer`` (``prefetch``, ``sampler``, ...). Prefetching threads
            may hand out the batches of one generator in another order.
    """

    def __init__(
        self,
        storage: FrameStorage,
        *,
        batch_size: int | None = None,
        generator: torch.Generator | None = None,
        transform: Transform | None = None,
        **kwargs: Any,
    ):
        kwargs = {
            "sampler": RandomSampler(),
            "writer": ImmutableDatasetWriter(),
            "collate_fn": as_it_is,
        } | kwargs
        super().__init__(
            storage=storage,
            batch_size=None if batch_size is None else as_int(batch_size, "batch_size", minimum=1),
            generator=generator,
            transform=transform,
            **kwargs,
        )

    @classmethod
    def open(
        cls, path: str | Path, *, frame_stack: int = 3, device: str | torch.device = "cpu", **kwargs: Any
    ) -> FrameDataset:
        """Open a finished dataset.

        Args:
            path: its directory.
            frame_stack: k, frames per stack.
            device: ``"cpu"`` maps the frames from disk; another device holds a copy of them and samples there. It needs
                a generator of the same device.
            **kwargs: see the class.

        Raises:
            DatasetError: naming the file that is missing, unfinished, truncated or foreign.
        """
        path = as_path(path)
        card = read_card(path)
        frames, transitions = map_parts(
            path, Layout.from_dict(card["layout"]), card["transitions"], card["frames"]
        )
        if torch.device(device).type != "cpu":
            frames, transitions = frames.to(device), transitions.to(device)
        frame_stack = as_int(frame_stack, "frame_stack")
        return cls(
            _MappedStorage(frames, transitions, frame_stack=frame_stack, path=path, card=card), **kwargs
        )

    @classmethod
    def create(
        cls, path: str | Path, *, domain: str, transitions: int, frame_stack: int = 3, **about: Any
    ) -> FrameDataset:
        """Begin a dataset, or continue one that was interrupted; a complete one is opened.

        Args:
            path: its directory.
            domain: the domain's name.
            transitions: after which it is complete: its card is written, and the last episode is cut to fit.
            frame_stack: k, frames per stack, of this object's samples.
            **about: further facts of the card that two attempts must agree in, such as ``task``, ``seed``,
                ``action_repeat``, ``quality``.

        Raises:
            DatasetError: if the directory holds something else, or another process is writing there.
        """
        path = as_path(path)
        request = {"domain": domain, "task": domain, **_ABOUT, **about, "transitions": transitions}
        for name in request.keys() & {"transitions", "seed", "action_repeat", "image_size"}:
            request[name] = as_int(request[name], name, minimum=0 if name == "seed" else 1)
        if not (path / CARD_FILE).exists():
            files = _EpisodeFiles(path, request)
            if not files.is_complete:
                empty = TensorDict({"pixels": torch.empty(0, 3, 1, 1, dtype=torch.uint8, device="cpu")}, [0])
                counters = {name: torch.empty(0, dtype=torch.int64, device="cpu") for name in ("row", "step")}
                storage = _MappedStorage(empty, TensorDict(counters, [0]), frame_stack=frame_stack, path=path)
                return cls(storage, writer=_DatasetWriter(files))
        _require_request(path, read_card(path).get("request", {}), request, "holds a dataset")
        return cls.open(path, frame_stack=frame_stack)

    # --- reading

    def sample_transitions(self, batch_size: int) -> TensorDict:
        """Draw as ``sample`` does, but leave out pixels, transforms and prefetching; see :meth:`stack_rows_of`."""
        with self._replay_lock:
            self._storage.load()
            index, _ = self._sampler.sample(self._storage, batch_size)
            return self._storage.columns_at(index).set("index", index)

    @property
    def is_read_directly(self) -> bool:
        """Whether a sample is what the storage returns: no transform, no prefetching, no collation."""
        return not (len(self._transform) or self._prefetch) and self._collate_fn is as_it_is

    def stack_rows_of(self, numbers: Tensor) -> Tensor:
        """Return which rows of :attr:`frames` make up observations, int64 ``[B, k]``, oldest to newest."""
        return self._storage.stack_rows_of(numbers)

    def observations(self, numbers: Tensor) -> Tensor:
        """Return observations by the number of their newest frame, uint8 ``[B, k * C, H, W]``."""
        return self._storage.observations(numbers)

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
    def image_size(self) -> int:
        """H = W of a frame, pixels."""
        return self._storage.pixels.shape[-1]

    @property
    def frames(self) -> TensorDictBase:
        """All frame rows, TensorDict ``[F]``: ``pixels`` uint8 ``[F, C, H, W]``, ``qpos`` and ``qvel``."""
        self._storage.load()
        return self._storage.frames

    @property
    def transitions(self) -> TensorDictBase:
        """All transition rows without pixels, TensorDict ``[N]``."""
        self._storage.load()
        return self._storage.transitions

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
        rows = torch.as_tensor(rows, device=self._storage.device)
        return state.apply(lambda column: column[rows], batch_size=rows.shape)

    def verify(self) -> None:
        """Read every byte and compare it with the checksums written at collection (2 GB take some seconds).

        Raises:
            DatasetError: naming the first damaged episode.
        """
        if self.path is None:
            raise DatasetError("Only a dataset on disk can be verified; this one was built in memory.")
        entries = _read_journal(self.path / JOURNAL_FILE)
        if sum(entry.transitions for entry in entries) != len(self):
            raise DatasetError(f"{self.path / JOURNAL_FILE} does not cover the dataset; collect it again.")
        layout = Layout.from_dict(self.card["layout"])
        for index, entry in enumerate(entries):
            if _checksum(self.path, layout, entries, index) != entry.crc32:
                raise DatasetError(
                    f"Episode {entry.episode} of {self.path} is damaged. Collect the dataset again."
                )

    # --- writing

    @property
    def is_complete(self) -> bool:
        """Whether all transitions that were asked for are there."""
        return not isinstance(self._writer, _DatasetWriter)

    @property
    def target(self) -> int:
        """Transitions that make it complete."""
        return len(self) if self.is_complete else self._writer.files.target

    @property
    def episodes(self) -> int:
        """Whole episodes, all of them durable."""
        return self.card["episodes"] if self.is_complete else len(self._writer.files.entries)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Append transitions in temporal order; an episode is durable, and can be sampled, once it has ended.

        What makes an episode is as in :class:`~crptpro.data.FrameReplay`, but each must begin at a reset. Transitions
        beyond those that were asked for are left out.

        Args:
            data: TensorDict ``[T]`` or ``[]`` of one environment.

        Returns:
            The indices of the transitions that became durable, int64.

        Raises:
            DatasetError: if the dataset is finished, an episode has other shapes, or the files cannot be written.
            DiskSpaceError: if the disk is full; whole episodes are kept.
            ValueError: for entries that are missing or of another shape.
            NonFiniteError: for a reward or an action that is NaN or infinite.
        """
        if self.is_complete:
            raise DatasetError(
                f"{self.path or 'This dataset'} is complete and read-only; collect another one."
            )
        with self._replay_lock:
            before = len(self)
            self._take(self._writer.rows(data, self._storage.frame_stack))
            return torch.arange(before, len(self), device="cpu")

    def add(self, data: TensorDictBase) -> Tensor:
        """Append one transition; see :meth:`extend`."""
        return self.extend(data)

    def end_episode(self) -> None:
        """End the running episode, which the environment has not ended: its last transition is truncated."""
        if not self.is_complete:
            with self._replay_lock:
                self._finish_episode()

    def note_environment(self, card: Mapping[str, Any]) -> None:
        """Note what renders the frames (``backend``, ``gl_renderer``, ...); the card lists it.

        Raises:
            DatasetError: if earlier episodes were rendered by another backend or renderer.
        """
        if not self.is_complete:
            self._writer.files.note_environment(dict(card))

    def begin(self) -> None:
        """Count the time that the card names from here on."""
        if not self.is_complete:
            self._writer.files.begin()

    def close(self) -> None:
        """Release the files of an unfinished dataset, which can be continued later."""
        if not self.is_complete:
            self._writer.files.close()

    def _take(self, rows: Rows) -> None:
        writer = self._writer
        missing = writer.files.target - len(self) - writer.pending_transitions
        rows = rows.part(0, max(0, missing))
        length = len(rows.following)
        if not length:
            return
        starts = rows.starts(writer.last_frame)
        edges = sorted({0, *starts, length})
        for first, end in itertools.pairwise(edges):
            part = rows.part(first, end)
            if first in starts:
                self._finish_episode()
                if len(part.first_frames()) > 1:
                    raise ValueError(
                        "An episode of a dataset begins at its reset, with a stack of one frame."
                    )
            writer.pending.append(part)
            if bool(part.columns["done"][-1]) or writer.pending_transitions == writer.files.target - len(
                self
            ):
                self._finish_episode()
                if self.is_complete:
                    return

    def _finish_episode(self) -> None:
        writer, storage = self._writer, self._storage
        if not writer.pending:
            return
        parts, writer.pending = writer.pending, []
        files = writer.files
        files.append(parts)
        if files.transitions >= files.target:
            files.finish()
            card = read_card(files.path)  # read back once before anybody is told that it is there
            storage.card = card
            self.set_writer(ImmutableDatasetWriter())
        rows = files.transitions, files.frames
        storage.replace(rows[0], lambda: map_parts(files.path, files.layout, *rows))


class _MappedStorage(FrameStorage):
    """The rows of a directory: copies and other processes map it anew instead of receiving it."""

    def __reduce__(self) -> Any:
        if not self.card:
            raise DatasetError(f"{self.path} is being collected: it can be copied once it is complete.")
        return _reopen, (self.path, self.frame_stack, str(self.device))


def _reopen(path: Path, frame_stack: int, device: str) -> FrameStorage:
    return FrameDataset.open(path, frame_stack=frame_stack, device=device).storage


class _DatasetWriter(ImmutableDatasetWriter):
    """The files of a dataset that is being collected, and the episode that has not ended."""

    def __init__(self, files: _EpisodeFiles):
        super().__init__()
        self.files, self.pending = files, list[Rows]()

    @property
    def pending_transitions(self) -> int:
        return sum(len(part.following) for part in self.pending)

    @property
    def last_frame(self) -> Tensor | None:
        return self.pending[-1].following[-1] if self.pending else None

    def rows(self, data: TensorDictBase, frame_stack: int) -> Rows:
        channels = 3 if self.files.layout is None else self.files.layout.channels
        state: list[Any] = [name for name in ("qpos", "qvel") if name in data and data.get(name).shape[-1]]
        state += [("next", name) for name in state]
        return read_rows(data, channels=channels, frame_stack=frame_stack, extra=state, what="A dataset")


@dataclass(frozen=True)
class _Entry:
    """One durable episode: its index, its rows, and the checksum of all bytes it added.

    ``wall_s`` is the time, in seconds, since the previous entry, or since this process opened the dataset.
    """

    episode: int
    transitions: int
    frames: int
    crc32: int
    is_cut: bool = False
    wall_s: float = 0.0

    def line(self) -> bytes:
        return json.dumps(asdict(self)).encode() + b"\n"


def _read_journal(path: Path) -> list[_Entry]:
    """Read the entries up to the first incomplete one (the line a kill interrupted)."""
    entries: list[_Entry] = []
    for line in path.read_bytes().split(b"\n")[:-1] if path.exists() else []:
        try:
            entry = _Entry(**json.loads(line))
        except (ValueError, TypeError):
            break
        if entry.episode != len(entries):
            break
        entries.append(entry)
    return entries


def _checksum(path: Path, layout: Layout, entries: list[_Entry], index: int) -> int | None:
    """Return the checksum of what an episode added to the files; ``None`` if one of them is missing."""
    checksum = 0
    for column in layout.columns():
        name = "frames" if column.part == FRAMES else "transitions"
        first = sum(getattr(entry, name) for entry in entries[:index])
        try:
            with open(path / column.file, "rb") as file:
                file.seek(first * column.row_bytes)
                checksum = zlib.crc32(file.read(getattr(entries[index], name) * column.row_bytes), checksum)
        except FileNotFoundError:
            return None
    return checksum


class _EpisodeFiles:
    """Appends episodes 0, 1, 2, ... to a directory until they hold the transitions asked for.

    The bytes of an episode are written and synced before its journal line, so the journal never promises what is not
    there. As long as no episode is durable, another request takes this one's place: one that was refused or failed
    never blocks the corrected one.
    """

    def __init__(self, path: Path, request: dict[str, Any]):
        self.path, self.request, self.target = path, request, request["transitions"]
        self.layout: Layout | None = None
        self.entries: list[_Entry] = []
        self.sessions: list[dict[str, Any]] = []
        self._noted_session = False
        self._files: dict[tuple[str, ...], int] = {}
        self._journal = -1
        self._since_s = time.monotonic()
        self._require_free()
        self._lock = DirectoryLock(path, error=DatasetError)
        try:
            # Another process may have finished it just now.
            self.is_complete = (path / CARD_FILE).exists()
            if self.is_complete:
                self.close()
            else:
                self._resume()
        except BaseException:
            self.close()
            raise

    @property
    def transitions(self) -> int:
        return sum(entry.transitions for entry in self.entries)

    @property
    def frames(self) -> int:
        return sum(entry.frames for entry in self.entries)

    def begin(self) -> None:
        """Count the time from here."""
        self._since_s = time.monotonic()

    def append(self, parts: list[Rows]) -> None:
        """Append an episode; it is durable when this returns."""
        columns, layout, is_cut = self._columns_of(parts)
        if self.layout is None:
            self.layout = layout
            self._save()
            self._open()
        elif layout != self.layout:
            raise DatasetError(
                f"{self.path} holds rows of {self.layout.to_dict()}, but episode {len(self.entries)} brings "
                f"{layout.to_dict()}. Collect it into another directory."
            )
        checksum, length, now = 0, len(columns[("step",)]), time.monotonic()
        with self._undone_on_failure():
            for column in self.layout.columns():
                content = (
                    np.ascontiguousarray(columns[column.key], dtype=column.dtype).reshape(-1).view(np.uint8)
                )
                checksum = zlib.crc32(content.data, checksum)
                _write_all(self._files[column.key], content)
            for file in self._files.values():
                os.fsync(file)
            wall_s = round(now - self._since_s, 3)
            entry = _Entry(len(self.entries), length, length + 1, checksum, is_cut, wall_s)
            _write_all(self._journal, np.frombuffer(entry.line(), np.uint8))
            os.fsync(self._journal)
        self.entries.append(entry)
        self._since_s = now

    def finish(self) -> None:
        """Write the card, which is the mark of a complete dataset, and release everything."""
        layout, transitions, frames = self.layout, self.transitions, self.frames
        assert layout is not None
        write_tensordict_metadata(self.path, layout, transitions, frames)
        card = {
            "format": FORMAT,
            "version": VERSION,
            "image_size": layout.image_size,
            **self.request,
            "request": self.request,
            "frame_stack": 3,
            "pixels": PIXELS,
            "episodes": len(self.entries),
            "frames": frames,
            "layout": layout.to_dict(),
            "bytes": layout.bytes(transitions, frames),
            "last_episode_cut": self.entries[-1].is_cut,
            "crc32": [entry.crc32 for entry in self.entries],
            "wall_time_s": round(sum(entry.wall_s for entry in self.entries), 1),
            "policy": "uniform random in [-1, 1]",
            "render": self.sessions[-1]["render"] if self.sessions else {},
            "sessions": self.sessions,
            **provenance(),
        }
        write_json(self.path / CARD_FILE, card)
        self.close()

    def note_environment(self, card: dict[str, Any]) -> None:
        for session in self.sessions:
            for name, label in (("backend", "render backend"), ("gl_renderer", "GL renderer")):
                before = session["render"].get(name)
                if before is not None and card.get(name, before) != before:
                    remedy = f"Continue with MUJOCO_GL={before}"
                    if name != "backend":
                        backend = session["render"].get("backend", "GL")
                        remedy = f"Continue on a machine where {backend} is this renderer"
                    raise DatasetError(
                        f"{self.path} was begun with the {label} {before!r}, now it is {card[name]!r}: their "
                        f"pixels differ. {remedy}, or remove the directory to begin anew."
                    )
        if self._noted_session:
            return
        self._noted_session = True
        if self.sessions and self.sessions[-1]["versions"] != versions():
            logger.warning("%s is continued with other package versions; its card lists both.", self.path)
        self.sessions.append({"versions": versions(), "render": card})
        self._save()

    def close(self) -> None:
        """Release files and lock; calling it twice is harmless."""
        for file in self._files.values():
            os.close(file)
        if self._files:
            os.close(self._journal)
        self._files = {}
        self._lock.release()

    def _columns_of(self, parts: list[Rows]) -> tuple[dict[tuple[str, ...], np.ndarray], Layout, bool]:
        """Return an episode's columns, its layout, and whether the environment did not end it."""

        def whole(name: Any) -> np.ndarray:
            return torch.cat([part.columns[name] for part in parts]).numpy()

        def per_frame(name: str) -> np.ndarray:
            return np.concatenate([whole(name), whole(("next", name))[-1:]])

        frames = torch.cat([parts[0].newest[:1], *(part.following for part in parts)])
        state = {name: per_frame(name) for name in ("qpos", "qvel") if name in parts[0].columns}
        done, terminated, truncated = (whole(name).copy() for name in ("done", "terminated", "truncated"))
        length, is_cut = len(done), not done[-1, 0]
        if is_cut:
            done[-1] = truncated[-1] = True
        step = np.arange(length)
        columns: dict[tuple[str, ...], np.ndarray] = {
            ("pixels",): frames.numpy(),
            **{(name,): values for name, values in state.items()},
            ("action",): whole("action"),
            ("next", "reward"): whole("reward"),
            ("next", "done"): done,
            ("next", "terminated"): terminated,
            ("next", "truncated"): truncated,
            ("row",): self.frames + step,
            ("step",): step,
            ("episode",): np.full(length, len(self.entries)),
        }
        channels, _, size = frames.shape[1:]
        sizes = {name: values.shape[-1] for name, values in state.items()}
        return columns, Layout(size, columns[("action",)].shape[-1], channels, sizes), bool(is_cut)

    @contextmanager
    def _undone_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException as reason:
            self._truncate()
            if not isinstance(reason, OSError):
                raise
            if is_disk_full(reason):
                raise DiskSpaceError(
                    f"The disk under {self.path} is full after {self.transitions} transitions "
                    f"({len(self.entries)} whole episodes), which are kept. Free space and run the same command "
                    "again."
                ) from reason
            raise DatasetError(f"{self.path} cannot be written: {reason}.") from reason

    def _truncate(self) -> None:
        """Drop whatever follows the last durable episode."""
        assert self.layout is not None
        for column in self.layout.columns():
            rows = self.frames if column.part == FRAMES else self.transitions
            _cut(self._files[column.key], rows * column.row_bytes)
        _cut(self._journal, sum(len(entry.line()) for entry in self.entries))

    def _require_free(self) -> None:
        """Refuse a directory with something else; what a kill at the very start left is none."""
        if not self.path.exists() or (self.path / COLLECTION_FILE).exists():
            return
        if any(item.name != ".lock" and not item.name.startswith(_TEMPORARY) for item in self.path.iterdir()):
            raise DatasetError(
                f"{self.path} is not empty and not a collection. Choose another directory or empty it."
            )

    def _resume(self) -> None:
        for stale in self.path.glob(f"{_TEMPORARY}*"):  # of a process that was killed: it had the lock
            stale.unlink(missing_ok=True)
        file = self.path / COLLECTION_FILE
        state: dict[str, Any] = {"format": FORMAT, "version": VERSION}
        if file.exists():
            state = read_json(file, error=DatasetError)
        if (state.get("format"), state.get("version")) != (FORMAT, VERSION):
            raise DatasetError(f"{file} belongs to another release or program. Choose another directory.")
        if state.get("layout") is None:
            self._save()
            return
        _require_request(self.path, state.get("request", {}), self.request, "was begun")
        self.layout, self.sessions = Layout.from_dict(state["layout"]), state.get("sessions", [])
        self.entries = journaled = _read_journal(self.path / JOURNAL_FILE)
        kept = len(journaled)
        while kept and _checksum(self.path, self.layout, journaled, kept - 1) != journaled[kept - 1].crc32:
            kept -= 1
        if journaled and not kept:
            raise DatasetError(
                f"{self.path} does not hold the episodes that its {JOURNAL_FILE} vouches for: the files are damaged "
                "from the first one on. Remove the directory to collect anew."
            )
        if kept < len(journaled):
            logger.warning(
                "%s: %d of %d finished episodes are damaged and will be collected again.",
                self.path, len(journaled) - kept, len(journaled),
            )  # fmt: skip
            self.entries = journaled[:kept]
        self._open()
        logger.info(
            "%s: continuing after %d of %d transitions", self.path.name, self.transitions, self.target
        )
        if self.transitions >= self.target:
            self.finish()
            self.is_complete = True

    def _open(self) -> None:
        assert self.layout is not None
        try:
            for column in self.layout.columns():
                path = self.path / column.file
                path.parent.mkdir(parents=True, exist_ok=True)
                self._files[column.key] = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            self._journal = os.open(self.path / JOURNAL_FILE, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as reason:
            raise DatasetError(f"{self.path} cannot be written: {reason}.") from reason
        self._truncate()

    def _save(self) -> None:
        content = {
            "format": FORMAT,
            "version": VERSION,
            "request": self.request,
            "layout": self.layout.to_dict() if self.layout else None,
            "sessions": self.sessions,
        }
        write_json(self.path / COLLECTION_FILE, content)


def _require_request(path: Path, found: dict[str, Any], request: dict[str, Any], what: str) -> None:
    """Compare the request that a directory was filled for with the one that is made now."""
    differing = [
        f"{name} {found.get(name)!r} there, {value!r} asked for"
        for name, value in request.items()
        if found.get(name) != value
    ]
    if differing:
        raise DatasetError(
            f"{path} {what} with other settings: {'; '.join(differing)}. "
            "Ask for the same, choose another directory, or remove this one to collect anew."
        )


def _write_all(file: int, content: np.ndarray) -> None:
    while len(content):
        content = content[os.write(file, content.data) :]


def _cut(file: int, size: int) -> None:
    os.ftruncate(file, size)
    os.lseek(file, 0, os.SEEK_END)


# --- cards -----------------------------------------------------------------------------------------------------------


def read_card(path: str | Path) -> dict[str, Any]:
    """Read and check a dataset's card against its files, without reading the frames.

    Raises:
        DatasetError: naming what is missing, unfinished, truncated or foreign.
    """
    path = Path(path)
    if not path.is_dir():
        raise DatasetError(
            f"{path} is not a directory. A dataset is made by collect_random or `crptpro collect`."
        )
    if not (path / CARD_FILE).exists():
        raise DatasetError(_why_no_card(path))
    card = read_json(path / CARD_FILE, error=DatasetError)
    for name, expected, what in (("format", FORMAT, "format"), ("version", VERSION, "format version")):
        if card.get(name) != expected:
            raise DatasetError(
                f"{path / CARD_FILE}: its {what} is {card.get(name)!r}, this release reads {expected!r}. It is "
                "foreign, or of another release: collect the dataset again."
            )
    missing = [name for name in (*_COUNTS, "layout", "domain", "task", "quality") if name not in card]
    wrong = [name for name in _COUNTS if not isinstance(card.get(name, 0), int)]
    try:
        layout = Layout.from_dict(card.get("layout", {}))
    except (KeyError, TypeError, ValueError, AttributeError):
        wrong.append("layout")
    if missing or wrong:
        raise DatasetError(
            f"{path / CARD_FILE} is damaged: {', '.join(missing + wrong)} missing or unusable."
        )
    if card.get("pixels") != PIXELS:
        raise DatasetError(
            f"The pixels of {path} are {card.get('pixels')!r}, this release reads {PIXELS!r}. Collect the dataset "
            "again."
        )
    if card["frames"] != card["transitions"] + card["episodes"] or card["transitions"] < 1:
        raise DatasetError(
            f"{path / CARD_FILE} is damaged: {card['frames']} frames do not fit {card['transitions']} "
            f"transitions in {card['episodes']} episodes, which have one frame more than transitions each."
        )
    for file, expected in layout.sizes(card["transitions"], card["frames"]).items():
        file_path = path / file
        if not file_path.is_file():
            raise DatasetError(f"{file_path} is missing. Collect the dataset again.")
        if (size := file_path.stat().st_size) != expected:
            raise DatasetError(size_problem(file_path, size, expected))
    return card


def _why_no_card(path: Path) -> str:
    collection = path / COLLECTION_FILE
    if not collection.exists():
        kinds = sorted(child.parent.name for child in path.glob(f"*/{CARD_FILE}"))
        hint = f" Did you mean one of its datasets: {', '.join(kinds)}?" if kinds else ""
        return f"{path} has no {CARD_FILE}: it is not a dataset.{hint}"
    wanted = read_json(collection, error=DatasetError).get("request", {}).get("transitions", "?")
    done = sum(entry.transitions for entry in _read_journal(path / JOURNAL_FILE))
    return (
        f"{path} is unfinished: {done} of {wanted} transitions are collected. "
        "Run the same collect command again to complete it."
    )

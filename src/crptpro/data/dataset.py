"""The frames of one domain on disk: written episode by episode, read as a TorchRL replay buffer."""

from __future__ import annotations

import logging
import math
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, RandomSampler

from crptpro.artifact import CARD_FILE, read_json, write_json
from crptpro.data.replay import as_it_is
from crptpro.data.storage import Rows, StackBuffer, StackStorage, map_rows, read_rows, require_size
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import DatasetError, DiskSpaceError, is_disk_full
from crptpro.provenance import provenance, warn_of_other_versions
from crptpro.values import as_int, as_path, as_plain

logger = logging.getLogger(__name__)

FORMAT, VERSION = "crptpro-frames", 2


class FrameDataset(StackBuffer):
    """The frames of one domain, sampled as pairs of consecutive stacks (x_t, x_t+1).

    ``sample(B)`` draws uniformly, with replacement, from all transitions and returns a TensorDict ``[B]`` with

    - ``pixels`` and ``("next", "pixels")``, uint8 ``[B, 3k, H, W]``, as of a live frame stack; a pair never crosses an
      episode;
    - ``action`` float32 ``[B, A]``, ``("next", "reward")`` float32 ``[B, 1]``,
      ``("next", "done" | "terminated" | "truncated")`` bool ``[B, 1]``;
    - ``index``, ``episode``, ``step`` in the episode, and ``number``, ``("next", "number")``: the rows of the
      observations' newest frames.

    Frames are mapped from disk without write access: processes may share a dataset, and threads an object.
    :meth:`open` reads a finished dataset; :meth:`create` begins or continues one, and ``extend`` takes what
    :class:`~crptpro.data.FrameReplay` takes, but each episode must begin at its reset. A program that resumes does not
    repeat episodes if it seeds by the number of those already stored::

        dataset = FrameDataset.create("data/mine", domain="mine", transitions=10_000)
        torch.manual_seed(env.set_seed(dataset.writer.episodes))
        for rollout in Collector(env, RandomPolicy(env.full_action_spec), frames_per_batch=100, total_frames=-1):
            dataset.extend(rollout)
            if dataset.is_complete:
                break

    Args:
        storage: what to read.
        **options: of TorchRL's ``ReplayBuffer``: ``batch_size`` (default of ``sample()``), ``generator`` (default:
            torch's global one), ``transform``, ``sampler``, ``prefetch`` (its threads may reorder batches).
    """

    def __init__(self, storage: FrameStorage, **options: Any):
        if not isinstance(storage, FrameStorage):
            raise TypeError(f"FrameDataset.open opens a directory; got {storage!r} as the storage.")
        parts = {"sampler": RandomSampler(), "writer": ImmutableDatasetWriter(), "collate_fn": as_it_is}
        super().__init__(storage=storage, **parts | options)

    @classmethod
    def open(
        cls, path: str | Path, *, frame_stack: int = 3, device: str | torch.device = "cpu", **options: Any
    ) -> FrameDataset:
        """Open a finished dataset.

        Args:
            path: its directory.
            frame_stack: k, frames per stack.
            device: ``"cpu"`` maps the frames from disk; another device holds a copy, from which it samples with a
                generator on that device.
            **options: see the class.

        Raises:
            DatasetError: a file is missing, unfinished, truncated or not written by crptpro.
        """
        return cls(FrameStorage(as_path(path), frame_stack, device), **options)

    @classmethod
    def create(
        cls, path: str | Path, *, domain: str, transitions: int, frame_stack: int = 3, **about: Any
    ) -> FrameDataset:
        """Begin a dataset, or continue one that was interrupted; a complete one is opened.

        It can be sampled once it has all ``transitions``; the last episode is cut to fit. ``about`` holds further
        entries of the card that every attempt must repeat: ``task``, ``seed``, ``action_repeat``, ... A directory with
        other content or another writer raises a DatasetError.
        """
        path = as_path(path).absolute()
        usual = {"task": domain, "seed": 0, "action_repeat": 1, "camera": None, "quality": "exact", "colors": "normal"}
        request = as_plain({"domain": domain, **usual, **about, "transitions": transitions}, "about")
        for name in request.keys() & {"transitions", "seed", "action_repeat", "image_size"}:
            request[name] = as_int(request[name], name, minimum=0 if name == "seed" else 1)
        card = _read(path) if (path / CARD_FILE).exists() else None
        if card is None or card["transitions"] < card["request"]["transitions"]:
            writer = EpisodeWriter(path, request)
            if writer.transitions < writer.target:
                return cls(FrameStorage(path, frame_stack, is_complete=False), writer=writer)
        dataset = cls.open(path, frame_stack=frame_stack)
        _require_request(path, dataset.card["request"], request)
        return dataset

    @property
    def card(self) -> dict[str, Any]:
        """The dataset's card; empty while it is being collected."""
        return self._storage.card

    @property
    def is_complete(self) -> bool:
        """Whether all requested transitions are stored."""
        return bool(self.card)

    @property
    def path(self) -> Path:
        return self._storage.path

    @property
    def domain(self) -> str:
        return self._complete.card["domain"]

    @property
    def frame_stack(self) -> int:
        return self._storage.frame_stack

    @property
    def image_size(self) -> int:
        """H = W of a frame, pixels."""
        return self._complete.pixels.shape[-1]

    @property
    def frames(self) -> TensorDictBase:
        """All frame rows, TensorDict ``[F]``: ``pixels`` uint8 ``[F, C, H, W]``, float64 ``qpos`` and ``qvel``."""
        return self._complete.frames

    @property
    def transitions(self) -> TensorDictBase:
        """All transition rows without pixels, TensorDict ``[N]``."""
        return self._complete.transitions

    @property
    def _complete(self) -> FrameStorage:
        self._storage.require_complete()
        return self._storage


class FrameStorage(StackStorage):
    """The rows of a dataset, read-only; copies and other processes map the files again.

    An episode of T transitions has T + 1 frames: those of a transition's observation and the next one are rows up to
    ``row`` and ``row + 1`` of the same episode.
    """

    def __init__(self, path: Path, frame_stack: int, device: str | torch.device = "cpu", *, is_complete: bool = True):
        self.frame_stack = as_int(frame_stack, "frame_stack", minimum=1)
        super().__init__(0)
        self.path, self.device = path.absolute(), torch.device(device)
        self.card: dict[str, Any] = {}
        if is_complete:
            self.load()

    def load(self) -> None:
        """Map the files of a complete dataset; anything else raises a DatasetError."""
        path = self.path
        if not path.is_dir():
            raise DatasetError(f"{path} is not a directory. A dataset is made by collect_random or `crptpro collect`.")
        if not (path / CARD_FILE).exists():
            names = ", ".join(sorted(child.parent.name for child in path.glob(f"*/{CARD_FILE}")))
            hint = f" Did you mean one of its datasets: {names}?" if names else ""
            raise DatasetError(f"{path} has no {CARD_FILE}: it is not a dataset.{hint}")
        card = _read(path)
        if card["transitions"] < (target := card["request"]["transitions"]):
            raise DatasetError(
                f"{path} is unfinished: {card['transitions']} of {target} transitions are collected. Run the same "
                "collect command again to complete it."
            )
        parts = {name: TensorDict({}, [card[name]]) for name in ("frames", "transitions")}
        for name, (dtype, shape) in card["columns"].items():
            part, *key = name.split("/")
            values = map_rows(path / f"{name}.memmap", getattr(torch, dtype), shape, len(parts[part]))
            parts[part].set(tuple(key), values)
        self.frames, self.transitions = parts["frames"], parts["transitions"].clone()  # a few MB, in RAM
        if self.device.type != "cpu":
            self.frames, self.transitions = self.frames.to(self.device), self.transitions.to(self.device)
        self.card, self.max_size = card, len(self.transitions)
        self.pixels = self.frames["pixels"]
        self.step = torch.zeros(len(self.frames), dtype=torch.int32, device=self.device)
        self.step[self.transitions["row"] + 1] = self.transitions["step"] + 1

    def columns_at(self, index: Tensor, **how: Any) -> TensorDict:
        self.require_complete()
        columns = self.transitions.apply(lambda column: column.index_select(0, index), batch_size=index.shape)
        number = columns.pop("row")
        return columns.set("number", number).set(("next", "number"), number + 1)

    def require_complete(self) -> None:
        if not self.card:
            raise DatasetError(f"{self.path} is being collected: it can be read once it is complete.")

    _empty = StackStorage.set

    def state_dict(self) -> dict[str, Any]:
        """Return what identifies this dataset: a checkpoint does not copy it."""
        return {**self.card.get("request", {}), "frame_stack": self.frame_stack}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Check that a checkpoint belongs to this dataset."""
        _require_request(self.path, self.state_dict(), state_dict)

    def __reduce__(self) -> Any:
        self.require_complete()
        return FrameStorage, (self.path, self.frame_stack, str(self.device))


class EpisodeWriter(ImmutableDatasetWriter):
    """Appends episodes 0, 1, 2, ... to a directory until they hold the requested transitions.

    An episode's rows are on disk before the card counts them; the next episode overwrites rows that a kill left
    uncounted. Until the first episode is durable, another request replaces this one. The directory is locked until the
    dataset is complete or :meth:`close` is called.
    """

    def __init__(self, path: Path, request: dict[str, Any]):
        super().__init__()
        self.path, self.request, self.target = path, request, request["transitions"]
        self.state: dict[str, Any] = {"format": FORMAT, "version": VERSION, "request": request, "columns": {}}
        self.state |= {"transitions": 0, "episodes": 0, "render": {}}
        self._pending: list[Rows] = []
        self._is_closed = False
        # A kill at the very start leaves the lock and perhaps a partial card.
        found = [each for each in path.glob("*") if each.name != ".lock" and each.suffix != ".partial"]
        if found and path / CARD_FILE not in found:
            raise DatasetError(f"{path} is not empty and not a collection. Choose another directory or empty it.")
        self._lock = DirectoryLock(path, error=DatasetError)
        try:
            self._resume()
        except BaseException:
            self.close()
            raise

    @property
    def transitions(self) -> int:
        return self.state["transitions"]

    @property
    def _write_count(self) -> int:  # which TorchRL's collectors read
        return self.transitions

    @property
    def episodes(self) -> int:
        return self.state["episodes"]

    @property
    def missing(self) -> int:
        return self.target - self.transitions - sum(len(part.following) for part in self._pending)

    def extend(self, data: TensorDictBase) -> Tensor:
        """Append transitions as a replay does, except surplus ones; returns the indices of those now durable, int64."""
        before = self.transitions
        if before >= self.target:
            raise DatasetError(f"{self.path} is complete and read-only; collect another one.")
        self._require_open()
        channels = self.state["columns"]["frames/pixels"][1][0] if before else 3
        extra: list[Any] = [name for name in ("qpos", "qvel") if name in data and data.get(name).shape[-1]]
        extra += [("next", name) for name in extra]
        frame_stack = self._storage.frame_stack
        rows = read_rows(data, channels=channels, frame_stack=frame_stack, extra=extra, what="A dataset")
        if (size := self.request.get("image_size")) not in (None, rows.following.shape[-1]):
            raise DatasetError(f"{self.path} is of image_size {size}, got frames {list(rows.following.shape[1:])}.")
        last = self._pending[-1].last_stack if self._pending else None
        for begins, part in rows.part(0, self.missing).pieces(last):
            if begins:
                self.end_episode()
                if len(part.first_frames()) > 1:
                    raise ValueError("An episode of a dataset begins at its reset, with a stack of one frame.")
            self._pending.append(part)
            if part.columns["done"][-1] or not self.missing:
                self.end_episode()
        return torch.arange(before, self.transitions, device="cpu")

    add = extend

    def end_episode(self) -> None:
        """Write the running episode; if the environment has not ended it, its last transition is marked truncated."""
        if not self._pending:
            return
        self._require_open()
        columns = self._pending_columns()
        self._pending = []
        described = {
            name: [str(values.dtype).removeprefix("torch."), list(values.shape[1:])] for name, values in columns.items()
        }
        if self.episodes and described != self.state["columns"]:
            raise DatasetError(
                f"{self.path} holds rows of {self.state['columns']}, but episode {self.episodes} has {described}. "
                "Collect it into another directory."
            )
        total = self.transitions + len(columns["transitions/row"])
        try:
            if not self.episodes:
                self._save()  # rows without a card would not be recognised after a kill
            for name, values in columns.items():
                rows = self.transitions + (self.episodes if name.startswith("frames/") else 0)
                _append(self.path / f"{name}.memmap", values, rows)
            self._save(columns=described, transitions=total, episodes=self.episodes + 1)
        except (OSError, DiskSpaceError) as reason:
            if not is_disk_full(reason):
                raise
            raise DiskSpaceError(
                f"The disk under {self.path} is full after {self.transitions} transitions ({self.episodes} whole "
                "episodes), which are kept. Free space and run the same command again."
            ) from reason
        self._storage.max_size = total
        if total >= self.target:
            self.close()
            self._storage.load()  # read back before it is reported as complete

    def note_rendering(self, gl: Mapping[str, Any]) -> None:
        """Record in the card what renders the frames; a ``backend`` or ``gl_renderer`` other than before is refused."""
        self._require_open()
        before = self.state["render"]
        for name in ("backend", "gl_renderer"):
            if name in before and gl.get(name, before[name]) != before[name]:
                raise DatasetError(
                    f"{self.path} was begun with the {name} {before[name]!r}, now it is {gl[name]!r}: their pixels "
                    f"differ. Continue with MUJOCO_GL={before.get('backend')} on that renderer, or remove the "
                    "directory to begin again."
                )
        self._save(render=dict(gl))

    def close(self) -> None:
        """Unlock the directory; an unfinished dataset can be continued later."""
        self._is_closed = True
        self._lock.release()

    def _require_open(self) -> None:
        if self._is_closed:
            raise DatasetError(f"The writer of {self.path} is closed; FrameDataset.create opens a new one.")

    def _pending_columns(self) -> dict[str, Tensor]:
        """Return the rows of the running episode by file."""
        parts, channels = self._pending, self._pending[0].following.shape[1]
        rows = {name: torch.cat([part.columns[name] for part in parts]) for name in parts[0].columns}
        columns = {"frames/pixels": torch.cat([parts[0].stacks[:1, -channels:], *(part.following for part in parts)])}
        for name in ("qpos", "qvel"):
            if name in rows:
                columns[f"frames/{name}"] = torch.cat([rows[name], rows["next", name][-1:]]).double()
        if not rows["done"][-1, 0]:
            rows["done"][-1] = rows["truncated"][-1] = True
        step = torch.arange(len(rows["done"]), device="cpu")
        return columns | {
            "transitions/action": rows["action"].float(),
            "transitions/next/reward": rows["reward"].float(),
            **{f"transitions/next/{name}": rows[name] for name in ("done", "terminated", "truncated")},
            "transitions/row": self.transitions + self.episodes + step,
            "transitions/step": step.int(),
            "transitions/episode": torch.full_like(step, self.episodes, dtype=torch.int32),
        }

    def _resume(self) -> None:
        for stale in self.path.glob(".*.partial"):  # of a killed process
            stale.unlink(missing_ok=True)
        state = _read(self.path) if (self.path / CARD_FILE).exists() else self.state
        if not state["episodes"]:
            for part in ("frames", "transitions"):  # of an episode that was being written
                shutil.rmtree(self.path / part, ignore_errors=True)
            return
        _require_request(self.path, state["request"], self.request)
        for path, expected in _sizes(self.path, state).items():
            require_size(path, min(expected, path.stat().st_size if path.exists() else 0), expected)
        self.state = state
        warn_of_other_versions(state, str(self.path))
        logger.info("%s: continuing after %d of %d transitions", self.path.name, self.transitions, self.target)

    def _save(self, **changes: Any) -> None:
        state = {**self.state, **changes}
        state["frames"] = state["transitions"] + state["episodes"]
        if state["columns"]:
            state["image_size"] = state["columns"]["frames/pixels"][1][-1]
        write_json(self.path / CARD_FILE, {**self.request, **state, **provenance()})
        self.state = state


def _append(path: Path, values: Tensor, rows: int) -> None:
    """Write rows after the first ``rows`` of a file, dropping any others, and sync it to disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab") as file:
        file.truncate(rows * (values.nbytes // len(values)))
        file.write(values.numpy().tobytes())
        file.flush()
        os.fsync(file.fileno())


def _sizes(path: Path, state: Mapping[str, Any]) -> dict[Path, int]:
    rows = {"transitions": state["transitions"], "frames": state["transitions"] + state["episodes"]}
    return {
        path / f"{name}.memmap": rows[name.split("/")[0]] * math.prod(shape) * getattr(torch, dtype).itemsize
        for name, (dtype, shape) in state["columns"].items()
    }


def _require_request(path: Path, found: Mapping[str, Any], request: Mapping[str, Any]) -> None:
    """Require that a directory was filled for the same request."""
    differing = [
        f"{name} {found.get(name)!r} there, {value!r} requested"
        for name, value in request.items()
        if found.get(name) != value
    ]
    if differing:
        raise DatasetError(
            f"{path} is a dataset of other settings: {'; '.join(differing)}. Use the same settings, choose another "
            "directory, or remove this one to collect it again."
        )


def _read(path: Path) -> dict[str, Any]:
    """Read the card of a dataset, which may be unfinished."""
    file = path / CARD_FILE
    card = read_json(file, error=DatasetError)
    if (kind := card.get("format")) != FORMAT:
        raise DatasetError(f"{path} has the format {kind!r}: it is not a dataset; `crptpro collect` makes one.")
    if (version := card.get("version")) != VERSION:
        raise DatasetError(f"{file} has version {version!r}; this release reads {VERSION}. Collect the dataset again.")
    return card

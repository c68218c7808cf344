"""The directory, record, checkpoints and progress of one training run, whatever it trains."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import signal
import threading
import time
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import psutil
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState, StateDictCheckpointAdapter
from torchrl.data import ReplayBuffer

from crptpro.artifact import require_disk
from crptpro.directory_lock import DirectoryLock, refusal_leaves_nothing
from crptpro.errors import (
    CheckpointError,
    DiskSpaceError,
    EnvCrashedError,
    NonFiniteError,
    RenderingError,
    is_disk_full,
)
from crptpro.logging import RunLogger
from crptpro.progress import Progress
from crptpro.provenance import provenance, warn_of_other_versions
from crptpro.seeding import derive_seed, kept_global_rng
from crptpro.values import as_path, as_plain

logger = logging.getLogger(__name__)

CHECKPOINT_SECONDS = 300.0  # between two checkpoints of a run without an interval
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name)]
"""Requests to stop: Ctrl-C, and what clusters send before they reclaim a machine."""
_running: set[Path] = set()  # run directories of this process


class Generators(dict[str, torch.Generator]):
    """Random generators by name, each with its own seed, and on the CPU unless ``devices`` names another device."""

    def __init__(self, seed: int, *names: str, devices: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        for name in names:
            device = (devices or {}).get(name)
            generator = torch.Generator(device if isinstance(device, torch.device) else "cpu")
            self[name] = generator.manual_seed(derive_seed(seed, "generator", name))

    def state_dict(self) -> dict[str, Tensor]:
        return {name: generator.get_state() for name, generator in self.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        for name, generator in self.items():
            generator.set_state(state[name])


class _Means:
    """Means of named scalars since the last row of a stream, summed on their device, each with its own count."""

    def __init__(self) -> None:
        self.sums: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}

    def add(self, values: Mapping[str, Tensor]) -> None:
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0) + value.detach().double()
            self.counts[name] = self.counts.get(name, 0) + 1

    def read(self) -> dict[str, float]:
        return {name: float(total) / self.counts[name] for name, total in self.sums.items()}

    def state_dict(self) -> dict[str, Any]:
        return vars(self)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.sums, self.counts = dict(state["sums"]), dict(state["counts"])


class _GlobalRNG(GlobalRNGState):
    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        state = dict(state_dict)
        # Of all GPUs; another machine may have fewer, or none.
        if cuda := state.pop("torch_cuda", [])[: torch.cuda.device_count()]:
            state["torch_cuda"] = cuda
        super().load_state_dict(state)


class Run:
    """The directory, record, checkpoints and progress of one training run.

    ::

        with Run(run_dir, unit="updates", streams=("pretrain",)) as run:
            run.require_same(settings)                      # refuses to continue a run of other settings
            run.keep(loss=loss, optimizer=optimizer)        # part of every checkpoint; restored here if there is one
            for update in run.until(total):                 # resumes, shows progress, checkpoints, stops on a signal
                ...
                run.log(losses)
                run.advance(1)
                if run.every(log_interval):
                    run.write("pretrain")
            run.finish()

    A run can be killed at any moment: the same call continues from its last checkpoint, and on a CPU with the same
    number of threads the numbers are those of an uninterrupted run. On Ctrl-C, SIGTERM, SIGHUP or SIGUSR1 the loop
    finishes its iteration and writes a checkpoint before it stops; a second Ctrl-C stops at once. The global random
    generators are left as they were.

    Args:
        run_dir: record and checkpoints; ``None`` keeps nothing.
        unit: what the position counts, ``"updates"`` or ``"env_steps"``; the first counter of every row.
        streams: those of the record that this run writes; :meth:`log` takes the first by default.
        records: a record in ``run_dir``, such as one that Weights & Biases mirrors; by default a plain one.
        config: settings, for the record.
        progress: show a bar, or lines in a log file.

    Attributes:
        position: progress in ``unit``, all resumptions included.
        resumed_from: position at which this call continued; 0 for a fresh run.
        counters: the loop's own counters, which every checkpoint holds; set them before :meth:`keep`.

    Raises:
        CheckpointError: ``run_dir`` is in use by another process, or all its checkpoints are damaged.
    """

    def __init__(
        self,
        run_dir: str | os.PathLike[str] | None,
        *,
        unit: str,
        streams: tuple[str, ...],
        records: RunLogger | None = None,
        config: Any = None,
        progress: bool = True,
    ) -> None:
        self.run_dir = None if run_dir is None else as_path(run_dir, "run_dir").absolute()
        self.unit, self.streams, self.records, self.config = unit, streams, records, config
        self.position = self.resumed_from = 0
        self.counters: dict[str, int] = {}
        self.settings: dict[str, Any] = {}
        self.saved: dict[str, Any] = {}
        self._rows: dict[str, list[dict[str, Any]]] = {stream: [] for stream in streams}  # without a record
        self._first_rows = dict.fromkeys(streams, 0)  # of the record
        self._means = {stream: _Means() for stream in streams}
        self._checkpoint = Checkpoint(format="archive")
        self._modules: list[nn.Module] = []
        self._stack = contextlib.ExitStack()
        self._signal: int | None = None
        self._has_record = False  # cut to the checkpoint
        self._last_advance = 0
        self._last_row = 0, 0.0  # position and training time
        self._started = self._saved_time = time.monotonic()
        self._is_shown = progress
        self._progress = Progress(0, 0, unit, is_shown=False)

    def __enter__(self) -> Run:
        with contextlib.ExitStack() as stack:
            stack.enter_context(kept_global_rng())
            if self.run_dir is not None:
                stack.enter_context(refusal_leaves_nothing(self.run_dir))
                stack.enter_context(DirectoryLock(self.run_dir, error=CheckpointError, is_reentrant=True))
                if (directory := self.run_dir.resolve()) in _running:
                    raise CheckpointError(f"Another run of this process is writing to {self.run_dir}.")
                _running.add(directory)
                stack.callback(_running.discard, directory)
                self._rotation = CheckpointRotation(self.run_dir / "checkpoints", keep_last=2)
                self._find_checkpoint()
                if self.records is None:
                    self.records = stack.enter_context(RunLogger(self.run_dir))
                elif not self.records.run_dir.resolve().is_relative_to(directory):
                    raise CheckpointError(
                        f"The record in {self.records.run_dir} is not in the run directory {self.run_dir}: a resumed "
                        f"run could not tell its rows from those of another. Use RunLogger({str(self.run_dir)!r})."
                    )
            if self.records is not None and self.config is not None:
                self.records.describe(self.config)
            if self.records is not None and self.run_dir is None:  # it may hold rows of other runs
                self._first_rows = self.records.state_dict(self.streams)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        try:
            self._progress.close()
        finally:
            self._stack.__exit__(*exception)  # type: ignore[arg-type]
        if self._signal is not None and exception[0] is None:  # it came after the last checkpoint that was due
            raise self._ended()

    @property
    def seconds(self) -> float:
        """Training time, all resumptions included."""
        return time.monotonic() - self._started

    def saved_setting(self, name: str, value: Any) -> Any:
        """Return a setting; ``"auto"`` becomes the value that the interrupted run resolved it to on its machine."""
        return self.saved.get("settings", {}).get(name, value) if value == "auto" else value

    def require_same(self, settings: Mapping[str, Any]) -> None:
        """Set everything that decides the run's numbers; a saved run of other settings is refused, naming them.

        A setting that a checkpoint cannot store raises a ``ValueError``.
        """
        self.settings = as_plain(settings, "settings")
        if not self.saved:
            return
        before, now = _flat(self.saved["settings"]), _flat(self.settings)
        pairs = {name: (before.get(name, "absent"), now.get(name, "absent")) for name in sorted({*before, *now})}
        differing = [f"{name} was {old!r}, now {new!r}" for name, (old, new) in pairs.items() if old != new]
        if differing:
            more = f" (and {len(differing) - 5} more)" if len(differing) > 5 else ""
            raise CheckpointError(
                f"{self.run_dir} holds a run with other settings: {'; '.join(differing[:5])}{more}. "
                "Use the same settings to continue it, or another run directory."
            )

    def keep(self, **components: Any) -> None:
        """Make objects with ``state_dict`` and ``load_state_dict`` part of every checkpoint, and restore them.

        A state may hold tensors, numbers, strings, NumPy arrays of numbers, and lists, tuples and dictionaries of them.
        ``None`` is left out.
        """
        # Those whose parameters must be finite: components, and the ``networks`` of other components.
        self._modules = [value for value in components.values() if isinstance(value, nn.Module)]
        self._modules += [network for value in components.values() for network in getattr(value, "networks", ())]
        means = {f"means_{stream}": value for stream, value in self._means.items()}
        for name, component in {**components, **means, "global_rng": _GlobalRNG()}.items():
            if component is not None:
                # TorchRL's usual payload maps its files: on a disk that fills up, the process would end by a bus error.
                payload = None if isinstance(component, ReplayBuffer) else StateDictCheckpointAdapter("archive")
                self._checkpoint.register(name, component, adapter=payload)
        if self.saved:
            try:
                self._checkpoint.load(self._latest, map_location="cpu")  # its GPU may have another index here
            except Exception as reason:
                cause = reason.__cause__ or reason
                if isinstance(cause, (EnvCrashedError, RenderingError, OSError)):  # not the checkpoint's fault
                    raise cause from None
                raise CheckpointError(f"The checkpoint {self._latest} does not fit this run: {reason}") from reason
            self.position = self.resumed_from = self.saved["position"]
            self._last_row = self.saved["last_row"]
            self.counters.update(self.saved["counters"])
            logger.info("Resuming from %s %s.", f"{self.position:,}", self.unit)
        self._saved_time = time.monotonic()
        self._started = self._saved_time - self.saved.get("seconds", 0.0)

    def until(self, total: int, *, checkpoint_interval: int | None = None) -> Iterator[int]:
        """Yield the position until it has reached ``total``; the body of the loop calls :meth:`advance`.

        Between two iterations a checkpoint is written when one is due (every ``checkpoint_interval`` in ``unit``, or
        every :data:`CHECKPOINT_SECONDS`), or when a signal asks the run to stop. At first, or before its first row, the
        record is cut to what the checkpoint counted; without one, the rows of an earlier attempt are set aside.
        """
        if self.position > total:
            raise CheckpointError(
                f"{self.run_dir} has done {self.position:,} {self.unit}, more than the {total:,} requested. Request at "
                "least as many, or choose another run directory."
            )
        self._restore_record()
        if self.resumed_from and self.position < total:
            warn_of_other_versions(self.saved["made_with"], str(self.run_dir))
        self._progress = Progress(total, self.position, self.unit, is_shown=self._is_shown)
        if threading.current_thread() is threading.main_thread():  # the only one that receives signals
            for number in SIGNALS:
                if signal.getsignal(number) in (signal.SIG_IGN, None):  # under nohup, or handled by C code
                    continue
                self._stack.callback(signal.signal, number, signal.signal(number, self._receive))
        while self.position < total:
            before = self.position
            yield self.position
            if self.position >= total:
                return
            if checkpoint_interval is None:
                is_due = time.monotonic() - self._saved_time >= CHECKPOINT_SECONDS
            else:
                is_due = self.position // checkpoint_interval > before // checkpoint_interval
            if is_due or self._signal is not None:
                self.save()
            if self._signal is not None:
                kept = "a checkpoint was written" if self.run_dir else "nothing is kept without run_dir"
                logger.warning("Stopped at %s of %s %s; %s.", f"{self.position:,}", f"{total:,}", self.unit, kept)
                raise self._ended()

    def _restore_record(self) -> None:
        if self._has_record or self.records is None or self.run_dir is None:
            return
        self._has_record = True
        if self.saved.get("record") is not None:
            self.records.load_state_dict(self.saved["record"])
        elif not self.saved:
            self.records.begin_again(self.streams)

    def _ended(self) -> BaseException:
        return KeyboardInterrupt() if self._signal == signal.SIGINT else SystemExit(128 + (self._signal or 0))

    def _receive(self, number: int, frame: object) -> None:
        if self._signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._signal = number
        with contextlib.suppress(OSError):  # a closed terminal, and a `tee` that got the same Ctrl-C, take no text
            logger.warning("Stopping as soon as a checkpoint can be written; press Ctrl-C again to stop at once.")

    def advance(self, count: int) -> None:
        """Move the position, and the bar with it."""
        self.position, self._last_advance = self.position + count, count
        self._progress.reach(self.position)

    def every(self, interval: int) -> bool:
        """Whether the last :meth:`advance` reached or crossed a multiple of ``interval``."""
        return self.position // interval > (self.position - self._last_advance) // interval

    def show(self, **values: float) -> None:
        """Show values beside the bar; in a log file a line at every twentieth of the run."""
        self._progress.show(**values)

    def finish(self) -> None:
        """Write the last checkpoint, which marks the run as complete."""
        if not (self.saved.get("is_finished") and self.saved["position"] == self.position):
            self.save(is_finished=True)

    def log(self, values: Mapping[str, Tensor | float] | TensorDictBase, stream: str | None = None) -> None:
        """Add scalars of one update to the means of a stream's next row; the first stream's by default.

        On a CPU, a loss that is not finite ends the run at once with a NonFiniteError; on a GPU the next row or
        checkpoint does, without a host synchronisation here.
        """
        found = {name: torch.as_tensor(value) for name, value in values.items()}
        for name, value in found.items():
            if name.startswith("loss") and value.device.type == "cpu" and not torch.isfinite(value).all():
                raise _not_finite(f"After {self.position:,} {self.unit}, {name} is {value.item()}")
        self._means[stream or self.streams[0]].add(found)

    def means(self, stream: str) -> dict[str, float]:
        """Return the means since the last row of a stream, empty if nothing was logged; losses must be finite."""
        means = self._means[stream].read()
        for name, value in means.items():
            if name.startswith("loss") and not torch.isfinite(torch.tensor(value)):
                raise _not_finite(f"After {self.position:,} {self.unit} or before, {name} is {value}")
        return means

    def write(
        self,
        stream: str,
        values: Mapping[str, Any] | None = None,
        *,
        extra: Mapping[str, float] | None = None,
        **counters: int,
    ) -> dict[str, Any]:
        """Write a row with the position and ``counters``, and return it without them.

        It holds ``extra`` and ``values``; by default the means since the last row, which start again, rate and memory.
        """
        counters = {self.unit: self.position, **counters}
        row: dict[str, Any] = {**(self.means(stream) if values is None else values), **(extra or {})}
        if values is None:
            self._means[stream].load_state_dict({"sums": {}, "counts": {}})
            if stream == self.streams[0]:
                row |= self._rate_and_memory()
        if self.records is None:
            self._rows[stream].append({**counters, **row})
        else:
            self._restore_record()
            self.records.log(row, stream=stream, **counters)
        return row

    def _rate_and_memory(self) -> dict[str, float]:
        (position, seconds), self._last_row = self._last_row, (self.position, self.seconds)
        row = {}
        if self.position > position and self.seconds > seconds:
            row[f"{self.unit}_per_s"] = (self.position - position) / (self.seconds - seconds)
        row["resident_bytes"] = psutil.Process().memory_info().rss
        if torch.cuda.is_initialized():
            row["device_peak_bytes"] = max(map(torch.cuda.max_memory_allocated, range(torch.cuda.device_count())))
        return row

    def rows(self, stream: str) -> list[dict[str, Any]]:
        """Return every row of a stream; with a record, those of all resumptions."""
        if self.records is None:
            return self._rows[stream]
        return self.records.rows(stream)[self._first_rows[stream] :]

    def save(self, *, is_finished: bool = False) -> None:
        """Write a checkpoint of the components of :meth:`keep`, whose parameters must be finite; two are kept."""
        for stream in self.streams:
            self.means(stream)
        for module in self._modules:
            for name, parameter in module.named_parameters():
                if not torch.isfinite(parameter.detach()).all():
                    raise _not_finite(f"After {self.position:,} {self.unit} the parameter {name} is not finite")
        self._saved_time = time.monotonic()
        if self.run_dir is None:
            return
        self._restore_record()
        # The new checkpoint is on disk twice for a moment; the first has the parameters and Adam's moments.
        sizes = [path.stat().st_size for path in self._rotation.directory.glob("checkpoint-*")]
        first = 3 * sum(parameter.nbytes for module in self._modules for parameter in module.parameters())
        remedy = "Earlier ones are kept; free space and run the same command again."
        require_disk(self.run_dir, 2 * max(sizes, default=first), "A checkpoint", remedy)
        self.saved = {
            "settings": self.settings,
            "position": self.position,
            "counters": dict(self.counters),
            "seconds": self.seconds,
            "last_row": self._last_row,
            "is_finished": is_finished,
            "record": None if self.records is None else self.records.state_dict(self.streams),
            "made_with": provenance(),
        }
        try:
            path = self._rotation.save(self._checkpoint, step=self.position, metadata={"run": self.saved})
            for written in (path, path.parent):
                _sync(written)
        except (OSError, RuntimeError) as reason:
            is_full = is_disk_full(reason) or "inline_container" in str(reason)  # a write of torch.save was cut short
            if isinstance(reason, RuntimeError) and not is_full:
                raise
            error, what = (DiskSpaceError, "the disk is full") if is_full else (CheckpointError, reason)
            raise error(
                f"No checkpoint could be written to {self._rotation.directory}: {what}. Earlier ones are kept; fix "
                "that and run the same command again."
            ) from reason

    def _find_checkpoint(self) -> None:
        """Read the newest checkpoint that is whole; damaged newer ones are removed, since they would outrank it."""
        damaged: list[Path] = []
        for stale in self._rotation.directory.glob(".checkpoint-*"):  # of a process that was killed while it wrote
            shutil.rmtree(stale) if stale.is_dir() else stale.unlink()
        for path in sorted(self._rotation.directory.glob("checkpoint-*"), reverse=True):
            try:
                with zipfile.ZipFile(path) as archive:
                    if (broken := archive.testzip()) is not None:
                        raise CheckpointError(f"{broken} in it is damaged")
                self.saved, self._latest = dict(Checkpoint.manifest(path)["metadata"]["run"]), path
            except Exception as reason:
                logger.warning("The checkpoint %s is damaged (%s); using the one before.", path, reason)
                damaged.append(path)
                continue
            for each in damaged:
                each.unlink()
            return
        if damaged:
            where = self._rotation.directory
            raise CheckpointError(f"All checkpoints in {where} are damaged. Remove that directory to start again.")


def _not_finite(what: str) -> NonFiniteError:
    return NonFiniteError(
        f"{what}. Training stopped and the last checkpoint is kept. "
        "Lower the learning rate, use precision='fp32', or check the data."
    )


def _sync(path: Path) -> None:
    """Make a file, or the names in a directory, durable."""
    with contextlib.suppress(OSError):  # some network file systems cannot sync a directory
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return nested settings under dotted names."""
    if isinstance(value, Mapping):
        items = [_flat(item, f"{name}.{key}".lstrip(".")) for key, item in value.items()]
    elif isinstance(value, (list, tuple)):
        items = [_flat(item, f"{name}[{index}]") for index, item in enumerate(value)]
    else:
        return {name: value}
    return {name: leaf for found in items for name, leaf in found.items()}

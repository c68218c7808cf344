"""One training run: its directory, its record, its checkpoints, its progress; it knows nothing of what is trained.

All training loops use it the same way::

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
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
import time
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import psutil
import torch
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from tqdm.auto import tqdm

from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CheckpointError, DiskSpaceError, NonFiniteError, is_disk_full
from crptpro.logging import RunLogger
from crptpro.provenance import provenance
from crptpro.seeding import derive_seed, kept_global_rng
from crptpro.values import as_path

logger = logging.getLogger(__name__)

CHECKPOINT_SECONDS = 300.0
"""Between two checkpoints of a run that names no interval."""
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name)
)
"""Requests to stop: Ctrl-C, and what clusters send before they take a machine away."""


class Generators(dict[str, torch.Generator]):
    """Random generators by name, each with its own seed, whose states a checkpoint holds.

    Args:
        seed: of the run.
        *names: of the generators.
        devices: of those that are not on the CPU.
    """

    def __init__(
        self, seed: int, *names: str, devices: Mapping[str, torch.device | None] | None = None
    ) -> None:
        super().__init__(
            {
                name: torch.Generator((devices or {}).get(name) or "cpu").manual_seed(
                    derive_seed(seed, "generator", name)
                )
                for name in names
            }
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state of every generator."""
        return {name: generator.get_state() for name, generator in self.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore :meth:`state_dict`."""
        for name, generator in self.items():
            generator.set_state(state[name])


class Means:
    """Running means of named scalars since the last row of the record, summed on the device."""

    def __init__(self) -> None:
        self.sums: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Take one more value of each name; names may come at different rates."""
        for name, value in values.items():
            value = value.detach().double()
            self.sums[name] = self.sums[name] + value if name in self.sums else value
            self.counts[name] = self.counts.get(name, 0) + 1

    def read(self) -> dict[str, float]:
        """Return the means."""
        return {name: float(total) / self.counts[name] for name, total in self.sums.items()}

    def clear(self) -> None:
        """Begin again."""
        self.sums, self.counts = {}, {}

    def state_dict(self) -> dict[str, Any]:
        """Return sums and counts."""
        return {"sums": self.sums, "counts": self.counts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.sums, self.counts = dict(state["sums"]), dict(state["counts"])


class Run:
    """The directory, record, checkpoints and progress of one training run.

    A run can be killed at any moment: the same call continues from its last checkpoint, and on a CPU with the same
    number of threads the numbers are those of an uninterrupted run. Ctrl-C, SIGTERM, SIGHUP and SIGUSR1 let the loop
    end its pass, write a checkpoint and leave; a second Ctrl-C leaves at once. The global random generators are left as
    they were.

    Args:
        run_dir: record and checkpoints; ``None`` keeps nothing.
        unit: what the position counts, ``"updates"`` or ``"env_steps"``; the first counter of every row.
        streams: of the record, that this run writes.
        records: used instead of a record in ``run_dir``.
        config: settings, for the record.
        resume: continue what ``run_dir`` holds; ``False`` refuses a directory that holds a run.
        progress: show a bar, or lines in a log file.

    Attributes:
        position: progress in ``unit``, all resumptions included.
        resumed_from: position at which this call continued; 0 for a fresh run.
        counters: further counters for every row.
        tally: whole numbers of the loop's own that every checkpoint holds; set them before :meth:`keep`.
        history: rows that this call wrote, by stream.

    Raises:
        CheckpointError: ``run_dir`` is in use by another process, holds a run that is not to be continued, or only
            damaged checkpoints.
    """

    def __init__(
        self,
        run_dir: str | os.PathLike[str] | None,
        *,
        unit: str,
        streams: tuple[str, ...],
        records: RunLogger | None = None,
        config: Any = None,
        resume: bool = True,
        progress: bool = True,
    ) -> None:
        self.run_dir = None if run_dir is None else as_path(run_dir, "run_dir")
        self.unit, self.streams, self.records, self.config = unit, streams, records, config
        self.resume, self.progress = resume, progress
        self.position = self.resumed_from = 0
        self.counters: dict[str, int] = {}
        self.tally: dict[str, int] = {}
        self.history: dict[str, list[dict[str, Any]]] = {stream: [] for stream in streams}
        self.means = {stream: Means() for stream in streams}
        self.settings: dict[str, Any] = {}
        self.saved: dict[str, Any] = {}
        self.made_with = provenance()
        self._checkpoint = Checkpoint(format="archive")
        self._modules: list[nn.Module] = []
        self._stack = contextlib.ExitStack()
        self._signal: int | None = None
        self._advance = 0
        self._started = self._saved_time = self._row_time = time.monotonic()
        self._row_position = 0
        self._earlier_seconds = 0.0
        self._bar: tqdm | None = None
        self._total, self._lines = 1, 0

    # --- beginning and end --------------------------------------------------------------------------------------

    def __enter__(self) -> Run:
        self._stack.enter_context(kept_global_rng())
        try:
            if self.run_dir is not None:
                self._stack.enter_context(
                    DirectoryLock(self.run_dir, error=CheckpointError, is_reentrant=True)
                )
                self._rotation = CheckpointRotation(self.run_dir / "checkpoints", keep_last=2)
                self._find_checkpoint()
                if self.records is None:
                    self.records = self._stack.enter_context(RunLogger(self.run_dir, config=self.config))
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            self._bar.close()
        self._stack.close()

    @property
    def seconds(self) -> float:
        """Training time, all resumptions included."""
        return self._earlier_seconds + time.monotonic() - self._started

    def saved_setting(self, name: str, asked: Any, *, open_value: Any = "auto") -> Any:
        """Return a setting that the user left open as the interrupted run had it, otherwise as asked.

        What ``"auto"`` stands for depends on the machine, and a run may be continued on another one.
        """
        return self.saved.get("settings", {}).get(name, asked) if asked == open_value else asked

    def require_same(self, settings: Mapping[str, Any]) -> None:
        """Name everything that decides the numbers of the run; plain values.

        Raises:
            CheckpointError: the run to be continued had other settings; the message names them.
        """
        self.settings = dict(settings)
        if not self.saved:
            return
        before, now, absent = _flat(self.saved["settings"]), _flat(self.settings), "absent"
        differing = [
            f"{name} was {before.get(name, absent)!r}, now {now.get(name, absent)!r}"
            for name in sorted({*before, *now})
            if before.get(name, absent) != now.get(name, absent)
        ]
        if differing:
            more = f" (and {len(differing) - 5} more)" if len(differing) > 5 else ""
            raise CheckpointError(
                f"{self.run_dir} holds a run with other settings: {'; '.join(differing[:5])}{more}. "
                "Use the same settings to continue it, or another run directory."
            )

    def keep(self, **components: Any) -> None:
        """Make objects with ``state_dict`` and ``load_state_dict`` part of every checkpoint, and restore them.

        ``None`` is left out. Without a checkpoint, the rows of an attempt that was killed before its first one are
        removed.

        Raises:
            CheckpointError: a component does not fit its saved state.
        """
        self._modules = [value for value in components.values() if isinstance(value, nn.Module)]
        means = {f"means_{stream}": value for stream, value in self.means.items()}
        for name, component in {**components, **means, "global_rng": GlobalRNGState()}.items():
            if component is not None:
                self._checkpoint.register(name, component)
        if self.saved:
            try:
                self._checkpoint.load(self._latest)
            except Exception as reason:
                raise CheckpointError(
                    f"The checkpoint {self._latest} does not fit this run: {reason}"
                ) from reason
            self.position = self.resumed_from = self._row_position = self.saved["position"]
            self._earlier_seconds = self.saved["seconds"]
            self.tally.update(self.saved["tally"])
            if self.records is not None and self.saved["record"] is not None:
                self.records.load_state_dict(self.saved["record"])
            logger.info("Continues from %s %s.", f"{self.position:,}", self.unit)
        elif self.records is not None and self.run_dir is not None and self.records.writes_into(self.run_dir):
            self.records.load_state_dict(dict.fromkeys(self.streams, 0))
        self._started = self._saved_time = self._row_time = time.monotonic()

    # --- the loop -----------------------------------------------------------------------------------------------

    def until(self, total: int, *, checkpoint_interval: int | None = None) -> Iterator[int]:
        """Yield the position until it has reached ``total``; the body of the loop calls :meth:`advance`.

        Between two passes a checkpoint is written when one is due, or when a signal asks the run to stop.

        Args:
            total: position at which the run is complete.
            checkpoint_interval: in ``unit``; ``None`` for :data:`CHECKPOINT_SECONDS`.

        Raises:
            CheckpointError: the run to be continued is already beyond ``total``.
        """
        if self.position > total and self.resumed_from:
            raise CheckpointError(
                f"{self.run_dir} has done {self.position:,} {self.unit}, {total:,} are asked: ask for at least as "
                "many, or choose another run directory."
            )
        self._show(total)
        self._listen()
        while self.position < total:
            before = self.position
            yield self.position
            stops = self._signal is not None and self.position < total
            if checkpoint_interval is None:
                is_due = time.monotonic() - self._saved_time >= CHECKPOINT_SECONDS
            else:
                is_due = self.position // checkpoint_interval > before // checkpoint_interval
            if self.position < total and (is_due or stops):
                self.save()
            if stops:
                kept = (
                    "nothing is kept without run_dir" if self.run_dir is None else "a checkpoint was written"
                )
                logger.warning(
                    "Stopped at %s of %s %s; %s.", f"{self.position:,}", f"{total:,}", self.unit, kept
                )
                if self._signal == signal.SIGINT:
                    raise KeyboardInterrupt
                raise SystemExit(128 + (self._signal or 0))

    def advance(self, count: int) -> None:
        """Move the position, and the bar with it."""
        self.position, self._advance = self.position + count, count
        if self._bar is not None:
            self._bar.update(count)

    def every(self, interval: int) -> bool:
        """Whether the last :meth:`advance` reached or crossed a multiple of ``interval``."""
        return self.position // interval > (self.position - self._advance) // interval

    def finish(self) -> None:
        """Write the last checkpoint, of a complete run."""
        if self.saved.get("is_finished") and self.saved["position"] == self.position:
            return
        self.save(is_finished=True)

    # --- the record ---------------------------------------------------------------------------------------------

    def log(self, values: Mapping[str, Tensor], stream: str | None = None) -> None:
        """Take scalars of one update into the means of a stream's next row; the first stream's by default.

        On a CPU, a loss that is not finite ends the run at once; on a GPU the next row or checkpoint does, without a
        host synchronisation here.

        Raises:
            NonFiniteError: naming the term.
        """
        for name, value in values.items():
            if name.startswith("loss") and value.device.type == "cpu" and not torch.isfinite(value).all():
                raise not_finite(f"After {self.position:,} {self.unit}, {name} is {value.item()}")
        self.means[stream or self.streams[0]].add(values)

    def row(self, stream: str) -> dict[str, float]:
        """Return the means since the last row of a stream.

        Raises:
            NonFiniteError: naming a term that is not finite.
        """
        means = self.means[stream].read()
        for name, value in means.items():
            if name.startswith("loss") and not torch.isfinite(torch.tensor(value)):
                raise not_finite(f"After {self.position:,} {self.unit} or before, {name} is {value}")
        return means

    def write(
        self,
        stream: str,
        values: Mapping[str, Any] | None = None,
        *,
        extra: Mapping[str, float] | None = None,
        **counters: int,
    ) -> dict[str, Any]:
        """Write a row: ``values``, or else the means since the last row, which begin again, with rate and memory.

        Args:
            stream: of the record.
            values: of the row.
            extra: further values beside the means.
            **counters: beside the position and :attr:`counters`.

        Returns:
            The row without its counters.
        """
        counters = {self.unit: self.position, **self.counters, **counters}
        if values is None:
            row: dict[str, Any] = {**self.row(stream), **(extra or {})}
            self.means[stream].clear()
            if stream == self.streams[0]:
                row |= self._rate_and_memory()
        else:
            row = dict(values)
        self.history[stream].append({**counters, **row})
        if self.records is not None:
            self.records.log(row, stream=stream, **counters)
        return row

    def _rate_and_memory(self) -> dict[str, float]:
        now, row = time.monotonic(), {}
        if self.position > self._row_position and now > self._row_time:
            row[f"{self.unit}_per_s"] = (self.position - self._row_position) / (now - self._row_time)
        row["resident_bytes"] = psutil.Process().memory_info().rss
        if torch.cuda.is_initialized():
            row["device_peak_bytes"] = torch.cuda.max_memory_allocated()
        self._row_time, self._row_position = now, self.position
        return row

    def rows(self, stream: str) -> list[dict[str, Any]]:
        """Return every row of a stream, of all resumptions where there is a record."""
        return self.history[stream] if self.records is None else self.records.rows(stream)

    def last_row(self, stream: str) -> dict[str, Any]:
        """Return the newest row of a stream without its counters; empty if there is none."""
        rows = self.history[stream] or ([] if self.records is None else self.records.rows(stream))
        left_out = {self.unit, *self.counters, "unix_time_s"}
        return {name: value for name, value in rows[-1].items() if name not in left_out} if rows else {}

    def show(self, **values: float) -> None:
        """Put values beside the bar; in a log file a line at every twentieth of the run."""
        if self._bar is None:
            return
        if not self._bar.disable:
            self._bar.set_postfix({name: f"{value:.4g}" for name, value in values.items()}, refresh=False)
        elif self.progress and 20 * self.position // self._total > self._lines:
            self._lines = 20 * self.position // self._total
            rate = (self.position - self.resumed_from) / max(time.monotonic() - self._started, 1e-9)
            logger.info(
                "%s of %s %s (%d %%), %s, %.2f/s, %.0f s left",
                f"{self.position:,}", f"{self._total:,}", self.unit, 100 * self.position // self._total,
                ", ".join(f"{name} {value:.4g}" for name, value in values.items()), rate,
                (self._total - self.position) / max(rate, 1e-9),
            )  # fmt: skip

    # --- checkpoints --------------------------------------------------------------------------------------------

    def save(self, *, is_finished: bool = False) -> None:
        """Write a checkpoint of everything that :meth:`keep` was given; two are kept.

        Raises:
            NonFiniteError: the run has diverged; earlier checkpoints are kept.
            DiskSpaceError: the disk is full; earlier checkpoints are kept.
        """
        for stream in self.streams:
            self.row(stream)
        for module in self._modules:
            require_finite_parameters(module, f"After {self.position:,} {self.unit}")
        self._saved_time = time.monotonic()
        if self.run_dir is None:
            return
        self.saved = {
            "settings": self.settings,
            "position": self.position,
            "tally": dict(self.tally),
            "seconds": self.seconds,
            "is_finished": is_finished,
            "record": None if self.records is None else self.records.state_dict(self.streams),
            "made_with": self.made_with,
        }
        try:
            path = self._rotation.save(self._checkpoint, step=self.position, metadata={"run": self.saved})
            for changed in (path, path.parent):
                sync(changed)
        except OSError as reason:
            if is_disk_full(reason):
                raise DiskSpaceError(
                    f"The disk is full: no checkpoint could be written to {self._rotation.directory}. Earlier ones are "
                    "kept; free space and start the same command again."
                ) from reason
            raise CheckpointError(
                f"No checkpoint could be written to {self._rotation.directory}: {reason}. Earlier ones are kept."
            ) from reason

    def _find_checkpoint(self) -> None:
        """Read the newest checkpoint that is whole; damaged newer ones are removed."""
        directory = self._rotation.directory
        paths = sorted(directory.glob("checkpoint-*"), reverse=True) if directory.is_dir() else []
        if paths and not self.resume:
            raise CheckpointError(
                f"{self.run_dir} already holds a run. Choose another directory, or continue it (resume=True)."
            )
        damaged = []
        for path in paths:
            try:
                with zipfile.ZipFile(path) as archive:
                    if (broken := archive.testzip()) is not None:
                        raise CheckpointError(f"{broken} in it is damaged")
                self.saved = dict(Checkpoint.manifest(path)["metadata"]["run"])
                self._latest = path
                break
            except Exception as reason:
                logger.warning("The checkpoint %s is damaged (%s); using the one before.", path, reason)
                damaged.append(path)
        if damaged and not self.saved:
            raise CheckpointError(
                f"All {len(damaged)} checkpoints in {directory} are damaged. Remove that directory to start again."
            )
        for path in damaged:  # they would outrank the checkpoints that follow
            path.unlink()

    # --- signals and the bar ------------------------------------------------------------------------------------

    def _listen(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return  # Python delivers signals to the main thread only
        for number in SIGNALS:
            self._stack.callback(signal.signal, number, signal.signal(number, self._receive))

    def _receive(self, number: int, frame: object) -> None:
        if self._signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._signal = number
        logger.warning("Stopping as soon as a checkpoint can be written; press Ctrl-C again to stop at once.")

    def _show(self, total: int) -> None:
        self._total = max(total, 1)
        self._lines = 20 * self.position // self._total
        self._bar = tqdm(
            total=total,
            initial=self.position,
            unit=self.unit.removesuffix("s").replace("_", " "),
            disable=None if self.progress else True,
            leave=False,
        )


def not_finite(what: str) -> NonFiniteError:
    """Return the error that ends a diverged run: what happened, what is kept, and the remedy."""
    return NonFiniteError(
        f"{what}. Training stopped and the last checkpoint is kept. "
        "Lower the learning rate, use precision='fp32', or check the data."
    )


def require_finite_parameters(module: nn.Module, when: str) -> None:
    """Refuse to keep a network whose last update spoilt a parameter that no metric has shown yet.

    Raises:
        NonFiniteError: naming the first parameter with a NaN or an infinity.
    """
    for name, parameter in module.named_parameters():
        if not torch.isfinite(parameter.detach().sum()) and not torch.isfinite(parameter.detach()).all():
            raise not_finite(f"{when} the parameter {name} is not finite")


def sync(path: Path) -> None:
    """Make a file, or the names in a directory, durable."""
    with contextlib.suppress(OSError):  # some network file systems cannot sync a directory
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested settings under dotted names."""
    items: Iterable[tuple[str, Any]]
    if isinstance(value, Mapping):
        items = [(f"{prefix}.{key}" if prefix else str(key), item) for key, item in value.items()]
    elif isinstance(value, (list, tuple)):
        items = [(f"{prefix}[{index}]", item) for index, item in enumerate(value)]
    else:
        return {prefix: value}
    return {name: leaf for key, item in items for name, leaf in _flat(item, key).items()}

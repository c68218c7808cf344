"""One object that a training loop logs to; what it writes locally is the record of the run."""

from __future__ import annotations

import dataclasses
import logging
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from crptpro.cards import provenance, write_json
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CheckpointError, CRPTproError
from crptpro.loggers.mirrors import Mirror, TensorboardMirror, WandbMirror, WandbOptions, main_counter
from crptpro.loggers.record import RESERVED, MetricRecord, Scalar

_LOG = logging.getLogger(__name__)
_STREAM = re.compile(r"[a-z][a-z0-9_]*")


class RunLogger:
    """Writes ``metrics.jsonl`` and one CSV per stream, and copies them to W&B and TensorBoard if asked.

    Rows are complete on disk when :meth:`log` returns. A mirror that fails is switched off with one warning;
    the run goes on. Usable as a context manager. The directory is held for this process until :meth:`close`.

    Args:
        run_dir: directory of the run, created if missing; rows found there are continued.
        config: settings of the run, a mapping or a dataclass; kept in ``config.json`` with versions and
            hardware, from the first row on.
        wandb: mirror to Weights & Biases; ``None`` for not.
        tensorboard: mirror to TensorBoard (needs the ``tensorboard`` extra).

    Raises:
        CheckpointError: if another process is running in ``run_dir``.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, RunLogger(folder) as logger:
        ...     logger.log({"loss_comp": 6.5}, stream="pretrain", updates=100)
        ...     logger.log({"loss_comp": 6.2, "updates_per_s": 3.0}, stream="pretrain", updates=200)
        ...     [row["updates"] for row in logger.rows("pretrain")]
        [100, 200]
    """

    def __init__(
        self,
        run_dir: str | Path,
        *,
        config: Any = None,
        wandb: WandbOptions | None = None,
        tensorboard: bool = False,
    ) -> None:
        self.run_dir = Path(run_dir)
        # Before the record is opened: opening repairs it, and a W&B run is one of this directory.
        self._lock = DirectoryLock(self.run_dir, error=CheckpointError, is_reentrant=True)
        self.record = MetricRecord(self.run_dir)
        settings = _as_dict(config)
        # Written with the first row: a request that is refused must not replace the settings of the run it found.
        self._unwritten_config = settings
        self._mirrors: list[Mirror] = []
        if wandb is not None:
            self._open("Weights & Biases", lambda: WandbMirror(wandb, self.run_dir, settings))
        if tensorboard:
            self._open("TensorBoard", lambda: TensorboardMirror(self.run_dir))

    def __enter__(self) -> RunLogger:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def log(self, metrics: Mapping[str, Any], *, stream: str, **counters: int) -> None:
        """Write one row.

        Args:
            metrics: names to numbers, scalar tensors or short strings; ``None`` leaves a cell empty.
            stream: which CSV, e.g. ``"pretrain"``, ``"train"``, ``"eval"``.
            counters: where the run is, e.g. ``updates=100`` or ``env_steps=1000, episodes=2``; at least one.
                The main one (``env_steps`` if given, else the first) is the x-axis of the mirrors.

        Raises:
            ValueError: no counter, a name used twice or reserved, or a value that is no scalar.
            DiskSpaceError: if the disk is full.
        """
        if not _STREAM.fullmatch(stream):
            raise ValueError(f"A stream is named by lower-case letters, digits and _, got {stream!r}.")
        if not counters:
            raise ValueError(f"A row of {stream!r} needs a counter, such as updates=100.")
        for key in metrics:
            if key in RESERVED or key in counters or "\n" in key or "," in key:
                raise ValueError(
                    f"{key!r} cannot name a metric of {stream!r}: reserved, a counter, or not plain."
                )
        values = {key: _scalar(key, value) for key, value in metrics.items() if value is not None}
        if self._unwritten_config:
            write_json(self.run_dir / "config.json", {"config": self._unwritten_config, **provenance()})
            self._unwritten_config = {}
        row = self.record.total_rows
        integers = {name: int(value) for name, value in counters.items()}
        self.record.append(stream, integers, values)
        self._copy(lambda mirror: mirror.log(stream, integers, values, row=row))

    def event(self, text: str) -> None:
        """Announce something on the console, one line."""
        _LOG.info("%s", text)

    def video(self, name: str, path: str | Path, **counters: int) -> None:
        """Copy a video file that was written to the mirrors, as ``name``."""
        self._copy(lambda mirror: mirror.video(name, Path(path), counters))

    def artifact(self, path: str | Path, *, name: str, kind: str) -> None:
        """Copy an artifact (a file or a directory) to the mirrors."""
        self._copy(lambda mirror: mirror.artifact(Path(path), name=name, kind=kind))

    def rows(self, stream: str) -> list[dict[str, Any]]:
        """Return the rows of a stream so far, oldest first."""
        return self.record.rows(stream)

    def state_dict(self, streams: Iterable[str] | None = None) -> dict[str, Any]:
        """Return how far the record goes, after forcing it to disk; belongs into every checkpoint.

        Args:
            streams: streams of the stage that makes the checkpoint, so that resuming it leaves those of other
                stages in the same directory alone; ``None`` for all.
        """
        self.record.sync()
        names = None if streams is None else list(streams)
        return {"rows": self.record.counts(names), "streams": names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take back the rows written after the checkpoint, so that the resumed run writes each row once."""
        before = self.record.counts()
        self.record.keep_first(state["rows"], only_these=state["streams"] is not None)
        self._rewind(before)

    def truncate_to(self, stream: str, counter: str, value: int) -> None:
        """Take back the rows of ``stream`` whose ``counter`` exceeds ``value`` (-1: all of them)."""
        before = self.record.counts()
        self.record.keep_until(stream, counter, value)
        self._rewind(before)

    def writes_into(self, directory: str | Path) -> bool:
        """Whether the record lies in ``directory`` or below it: only then is all of it that directory's own."""
        return self.run_dir.resolve().is_relative_to(Path(directory).resolve())

    def close(self) -> None:
        """Finish the mirrors and free the directory; every row is on disk already."""
        self._copy(lambda mirror: mirror.close())
        self._mirrors = []
        self._lock.release()

    def _rewind(self, before: Iterable[str]) -> None:
        if not self._mirrors:
            return
        last = dict.fromkeys(before, -1)  # a stream that lost all its rows is to be forgotten from the start
        for stream in self.record.counts():
            for row in self.record.rows(stream)[-1:]:
                last[stream] = row[main_counter({k: v for k, v in row.items() if k not in RESERVED})]
        self._copy(lambda mirror: mirror.rewind(last))

    def _open(self, name: str, make: Callable[[], Mirror]) -> None:
        try:
            self._mirrors.append(make())
        except Exception as reason:
            _LOG.warning("%s is off for this run (%s); the local record is complete.", name, reason)

    def _copy(self, call: Callable[[Mirror], None]) -> None:
        for mirror in list(self._mirrors):
            try:
                call(mirror)
            except Exception as reason:
                self._mirrors.remove(mirror)
                _LOG.warning(
                    "%s failed and is off from here (%s); the local record in %s is complete.",
                    mirror.name, reason, self.run_dir,
                )  # fmt: skip


def _as_dict(config: Any) -> dict[str, Any]:
    if config is None:
        return {}
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return dataclasses.asdict(config)
    if isinstance(config, Mapping):
        return dict(config)
    raise CRPTproError(f"The config of a run is a mapping or a dataclass, got a {type(config).__name__}.")


def _scalar(key: str, value: Any) -> Scalar:
    if isinstance(value, str):
        return value.replace("\n", " ")
    try:
        number = value.item() if hasattr(value, "item") else value
        return int(number) if isinstance(number, int) else float(number)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"The metric {key!r} is no scalar: {value!r}.") from None

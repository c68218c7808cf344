"""The record of a run, complete on disk after every row, and its mirrors on Weights & Biases and TensorBoard."""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import netrc
import os
import re
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from crptpro.artifact import write_json, write_whole
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CheckpointError, writing_error
from crptpro.provenance import provenance
from crptpro.values import as_int, as_path, as_plain

_LOG = logging.getLogger(__name__)

WANDB_FILE = "wandb_run.json"  # the id of the directory's W&B run


class RunLogger:
    """Writes ``metrics.jsonl`` and one CSV per stream, and mirrors them to W&B and TensorBoard if requested.

    Rows are on disk when :meth:`log` returns; a CSV that disagrees with ``metrics.jsonl`` is rewritten. Settings and
    mirrors begin with the first row, so that a refused request leaves no trace. A mirror that fails is switched off
    with one warning. The directory is locked until :meth:`close`, or the end of a ``with`` block.

    Args:
        run_dir: directory of the run, created if missing; rows found there are continued.
        wandb: mirror to Weights & Biases, with these arguments of ``wandb.init``. By default the project is
            ``WANDB_PROJECT`` or crptpro, the name ``WANDB_NAME`` or the directory's, and the mode ``WANDB_MODE``, or
            online if logged in, else offline (``wandb sync`` uploads it later).
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
        self, run_dir: str | Path, *, wandb: Mapping[str, Any] | None = None, tensorboard: bool = False
    ) -> None:
        self.run_dir = as_path(run_dir, "run_dir").absolute()
        self.path = self.run_dir / "metrics.jsonl"
        self._config: dict[str, Any] = {}
        self._lock = DirectoryLock(self.run_dir, error=CheckpointError, is_reentrant=True)
        self._rows, self._columns = self._read(), dict[str, list[str]]()
        for stream in {row["stream"] for row in self._rows}:
            self._write_csv(stream)
        self._has_begun = False
        self._mirrors: list[_Wandb | _TensorBoard] = []
        if wandb is not None:
            self._mirrors.append(_Wandb(dict(wandb), self.run_dir, self._config))
        if tensorboard:
            self._mirrors.append(_TensorBoard(self.run_dir))

    def __enter__(self) -> RunLogger:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def describe(self, config: Any) -> None:
        """Add settings of the run, a mapping or a dataclass, before its first row.

        They are kept in ``config.json`` with versions and hardware.
        """
        self._config.update(as_plain(config, "config"))

    def log(self, metrics: Mapping[str, Any], *, stream: str, **counters: int) -> None:
        """Write one row.

        Args:
            metrics: names to numbers, scalar tensors or short texts; ``None`` leaves a cell empty.
            stream: which CSV, e.g. ``"train"``.
            counters: at least one, e.g. ``env_steps=1000, episodes=2``. The mirrors plot against ``env_steps`` if
                given, else the first.

        Raises:
            ValueError: no counter, a name used twice, reserved or not printable, or a value that is not a scalar.
            DiskSpaceError: if the disk is full; no half row stays behind.
        """
        if not re.fullmatch(r"[a-z][a-z0-9_]*", stream):
            raise ValueError(f"A stream is named by lower-case letters, digits and _, got {stream!r}.")
        if not counters:
            raise ValueError(f"A row of {stream!r} needs a counter, such as updates=100.")
        metrics = dict(metrics.items())  # a TensorDict iterates over its rows
        for key in (*counters, *metrics):
            is_taken = key in ("stream", "unix_time_s") or (key in counters and key in metrics)
            if is_taken or not key or not key.isprintable() or re.search('[,"]', key):
                raise ValueError(
                    f"{key!r} cannot name a metric of {stream!r}: it is reserved, a counter, or unfit for a CSV header."
                )
        where = {name: as_int(value, name) for name, value in counters.items()}
        values = {key: _scalar(key, value) for key, value in metrics.items() if value is not None}
        if not self._has_begun and self._config:
            write_json(self.run_dir / "config.json", {"config": self._config, **provenance()})
        self._has_begun = True
        columns, index = self._columns.get(stream, []), len(self._rows)
        row = {"stream": stream, **where, "unix_time_s": round(time.time(), 3)}
        # NaN and infinity as words: they are not JSON, and the CSV shows the same.
        for key, value in values.items():
            row[key] = str(value) if isinstance(value, float) and not math.isfinite(value) else value
        _append(self.path, json.dumps(row) + "\n")
        self._rows.append(row)
        if row.keys() <= {"stream", *columns}:
            _append(self.run_dir / f"{stream}.csv", _csv_text([[row.get(name) for name in columns]]))
        else:
            self._write_csv(stream)
        self._mirror(lambda mirror: mirror.log(stream, where, values, index))

    def artifact(self, path: str | Path, *, name: str, kind: str) -> None:
        """Copy an artifact (a file or a directory) to W&B."""
        self._mirror(lambda mirror: mirror.artifact(Path(path), name, kind))

    def rows(self, stream: str) -> list[dict[str, Any]]:
        """Return the rows of a stream so far, oldest first, without the stream's name."""
        found = [row for row in self._rows if row["stream"] == stream]
        return [{name: value for name, value in row.items() if name != "stream"} for row in found]

    def state_dict(self, streams: Iterable[str]) -> dict[str, int]:
        """Return the number of rows per stream, synced to disk, for a checkpoint."""
        self._sync()
        return {name: len(self.rows(name)) for name in streams}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Remove the rows written after the checkpoint, so that the resumed run writes each row once.

        Streams that ``state`` does not name belong to other stages in the same directory and are left alone.
        """
        seen, kept = Counter[str](), []
        for row in self._rows:
            seen[row["stream"]] += 1
            if seen[row["stream"]] <= state.get(row["stream"], math.inf):
                kept.append(row)
        for name, count in state.items():
            if (missing := count - seen[name]) > 0:
                _LOG.warning("%s: %d rows of %r are missing that the checkpoint counted.", self.path, missing, name)
        if len(kept) < len(self._rows):
            write_whole(self.path, "".join(json.dumps(row) + "\n" for row in kept))
        self._rows = kept
        for stream in seen:
            self._write_csv(stream)

    def begin_again(self, streams: Iterable[str]) -> None:
        """Remove the rows of a run without a checkpoint: ``metrics.before.jsonl`` keeps them, as does their W&B run."""
        streams = list(streams)
        if any(map(self.rows, streams)):
            kept = self.path.with_suffix(".before.jsonl")
            before = kept.read_bytes() if kept.exists() else b""
            write_whole(kept, before + self.path.read_bytes())
            # W&B drops rows below the last index of a run, so the new rows need another run.
            (self.run_dir / WANDB_FILE).unlink(missing_ok=True)
            _LOG.warning("%s has no checkpoint: it begins again; its earlier rows are in %s.", self.run_dir, kept)
        self.load_state_dict(dict.fromkeys(streams, 0))

    def close(self) -> None:
        """Finish the mirrors and unlock the directory; every row is on disk already."""
        self._mirrors = [mirror for mirror in self._mirrors if "logger" in vars(mirror)]  # that have begun
        self._mirror(lambda mirror: mirror.close())
        self._mirrors = []
        if self._has_begun:
            self._sync()
        self._lock.release()

    def _read(self) -> list[dict[str, Any]]:
        """Read all rows; a torn line, or one not written by crptpro, is dropped from the file with a warning."""
        lines = self.path.read_bytes().splitlines(keepends=True) if self.path.exists() else []
        rows = []
        for line in lines:
            try:
                row = json.loads(line)
            except ValueError:
                continue
            if isinstance(row, dict) and isinstance(row.get("stream"), str) and line.endswith(b"\n"):
                rows.append(row)
        if len(rows) < len(lines):
            _LOG.warning("%s: dropped %d damaged line(s).", self.path, len(lines) - len(rows))
            write_whole(self.path, "".join(json.dumps(row) + "\n" for row in rows))
        return rows

    def _write_csv(self, stream: str) -> None:
        rows, path = self.rows(stream), self.run_dir / f"{stream}.csv"
        columns = list(dict.fromkeys(name for row in rows for name in row))
        content = _csv_text([columns, *([row.get(name) for name in columns] for row in rows)])
        if not columns:
            path.unlink(missing_ok=True)
        elif not path.exists() or path.read_bytes() != content.encode():
            write_whole(path, content)
        self._columns[stream] = columns

    def _sync(self) -> None:
        for path in (self.path, *(self.run_dir / f"{stream}.csv" for stream in self._columns)):
            if path.exists():
                with open(path, "rb") as file:
                    os.fsync(file.fileno())

    def _mirror(self, call: Callable[[_Wandb | _TensorBoard], None]) -> None:
        for mirror in list(self._mirrors):
            try:
                call(mirror)
            except Exception as reason:
                self._mirrors.remove(mirror)
                _LOG.warning("%s is off (%s); the local record in %s is complete.", mirror.name, reason, self.run_dir)


@dataclass
class _Wandb:
    """One W&B run per directory. A row's index is its step: W&B drops those that a resumed run repeats."""

    options: dict[str, Any]
    run_dir: Path
    config: dict[str, Any]
    streams: set[str] = field(default_factory=set)
    name = "Weights & Biases"

    @cached_property
    def logger(self) -> Any:
        """TorchRL's logger; the W&B run begins when it is first used."""
        from torchrl.record.loggers import get_logger

        arguments = {
            "project": os.environ.get("WANDB_PROJECT") or "crptpro",
            "name": os.environ.get("WANDB_NAME") or self.run_dir.name,
            "mode": _wandb_mode(),
            "config": self.config,
            "id": _wandb_id(self.run_dir),
            "reinit": "create_new",
            "settings": {"silent": True, "console": "off", "init_timeout": 60.0, "finish_timeout": 60.0},
            "log_env_packages": False,
            **self.options,
        }

        def start(**changed: str) -> Any:
            return get_logger("wandb", str(self.run_dir), arguments["name"], wandb_kwargs={**arguments, **changed})

        try:
            return start()
        except Exception as reason:
            if arguments["mode"] != "online":
                raise
            _LOG.warning("W&B cannot be reached (%s); logging offline, `wandb sync` uploads it later.", reason)
            return start(mode="offline")

    def log(self, stream: str, counters: Mapping[str, int], values: Mapping[str, Any], index: int) -> None:
        if stream not in self.streams:
            self.logger.experiment.define_metric(_axis(counters))
            self.logger.experiment.define_metric(f"{stream}/*", step_metric=_axis(counters))
            self.streams.add(stream)
        row = {**counters, **{f"{stream}/{key}": value for key, value in values.items()}}
        self.logger.log_metrics(row, step=index, override_global_step=True)

    def artifact(self, path: Path, name: str, kind: str) -> None:
        import wandb

        # W&B takes letters, digits, dash, underscore and dot; a Gymnasium task has a colon.
        artifact = wandb.Artifact(re.sub(r"[^\w.-]", "_", name), type=kind)
        (artifact.add_dir if path.is_dir() else artifact.add_file)(str(path))
        self.logger.experiment.log_artifact(artifact)

    def close(self) -> None:
        self.logger.experiment.finish()


@dataclass
class _TensorBoard:
    """Event files in ``<run_dir>/tensorboard``; they hold numbers only."""

    run_dir: Path
    name = "TensorBoard"

    @cached_property
    def logger(self) -> Any:
        from torchrl.record.loggers import get_logger

        return get_logger("tensorboard", str(self.run_dir), "tensorboard")

    def log(self, stream: str, counters: Mapping[str, int], values: Mapping[str, Any], index: int) -> None:
        numbers = {f"{stream}/{key}": value for key, value in values.items() if not isinstance(value, str)}
        self.logger.log_metrics(numbers, step=counters[_axis(counters)])

    def artifact(self, path: Path, name: str, kind: str) -> None: ...

    def close(self) -> None:
        self.logger.experiment.close()


def _axis(counters: Mapping[str, int]) -> str:
    return "env_steps" if "env_steps" in counters else next(iter(counters))


def _wandb_mode() -> str:
    """Return what W&B's own settings say, without network access."""
    if mode := os.environ.get("WANDB_MODE"):
        return mode
    if os.environ.get("WANDB_API_KEY"):
        return "online"
    host = urlparse(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai")).hostname or ""
    try:
        known = netrc.netrc(str(Path(os.environ.get("NETRC", "~/.netrc")).expanduser())).hosts
    except (OSError, netrc.NetrcParseError):
        return "offline"
    return "online" if host in known else "offline"


def _wandb_id(run_dir: Path) -> str:
    """Return the id of this directory's W&B run, drawn once and kept."""
    path = run_dir / WANDB_FILE
    try:
        return str(json.loads(path.read_text())["id"])
    except (OSError, ValueError, KeyError, TypeError):
        identity = uuid.uuid4().hex[:8]
        write_json(path, {"id": identity})
        return identity


def _scalar(key: str, value: Any) -> int | float | str:
    if isinstance(value, str):  # on one line, encodable as UTF-8
        return " ".join(value.splitlines()).encode("utf-8", "backslashreplace").decode()
    try:
        number = value.item() if hasattr(value, "item") else value
        return int(number) if isinstance(number, int) else float(number)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"The metric {key!r} is not a scalar: {value!r}.") from None


def _csv_text(rows: Iterable[Iterable[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _append(path: Path, line: str) -> None:
    size = path.stat().st_size if path.exists() else 0
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write(line)
    except OSError as reason:
        if path.exists():
            os.truncate(path, size)
        raise writing_error(path, reason) from reason

"""Where metrics go besides the local record: W&B and TensorBoard. Both may fail; a run may not."""

from __future__ import annotations

import json
import logging
import netrc
import os
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol
from urllib.parse import urlparse

from crptpro.cards import write_json

_LOG = logging.getLogger(__name__)

WANDB_RUN_FILE = "wandb_run.json"


@dataclass(frozen=True)
class WandbOptions:
    """How a run appears on Weights & Biases."""

    project: str = "crptpro"
    """project"""
    entity: str | None = None
    """user or team; None for the account's default"""
    group: str | None = None
    """runs of one comparison"""
    name: str | None = None
    """display name; None for the run directory's name"""
    tags: tuple[str, ...] = ()
    """tags"""
    job_type: str | None = None
    """stage, e.g. pretrain"""
    mode: Literal["auto", "online", "offline"] = "auto"
    """auto: ``WANDB_MODE`` if set, online if logged in, else offline (``wandb sync`` uploads it later)"""
    settings: dict[str, Any] = field(default_factory=dict)
    """further ``wandb.Settings``"""


class Mirror(Protocol):
    """Receives copies of what the record holds."""

    name: str

    def log(self, stream: str, counters: Mapping[str, int], metrics: Mapping[str, Any], *, row: int) -> None:
        """Copy one row; ``row`` is its index among the rows of all streams."""

    def video(self, name: str, path: Path, counters: Mapping[str, int]) -> None:
        """Copy a video file."""

    def artifact(self, path: Path, *, name: str, kind: str) -> None:
        """Copy a file or directory."""

    def rewind(self, last: Mapping[str, int]) -> None:
        """Forget rows after the given value of the main counter, per stream."""

    def close(self) -> None:
        """Finish."""


class WandbMirror:
    """A W&B run with the same identity however often the run is resumed.

    Rows carry their index as W&B's step, so rows that a resumed run repeats are dropped or overwritten by W&B
    instead of shown twice.
    """

    name = "Weights & Biases"

    def __init__(self, options: WandbOptions, run_dir: Path, config: Mapping[str, Any]) -> None:
        import wandb

        self._wandb: Any = wandb
        mode = wandb_mode(options.mode)
        try:
            self._run = self._start(options, run_dir, config, mode)
        except Exception as reason:
            if mode != "online":
                raise
            _LOG.warning(
                "W&B cannot be reached (%s); logging offline, `wandb sync` uploads it later.", reason
            )
            self._run = self._start(options, run_dir, config, "offline")
        self._defined: set[str] = set()

    def log(self, stream: str, counters: Mapping[str, int], metrics: Mapping[str, Any], *, row: int) -> None:
        """Copy one row as ``<stream>/<metric>``, plotted against its main counter."""
        if stream not in self._defined:
            axis = main_counter(counters)
            self._run.define_metric(axis)
            self._run.define_metric(f"{stream}/*", step_metric=axis)
            self._defined.add(stream)
        self._run.log({**counters, **{f"{stream}/{key}": value for key, value in metrics.items()}}, step=row)

    def video(self, name: str, path: Path, counters: Mapping[str, int]) -> None:
        """Upload a video file beside the next row."""
        self._run.log({**counters, name: self._wandb.Video(str(path))}, commit=False)

    def artifact(self, path: Path, *, name: str, kind: str) -> None:
        """Upload a file or directory as a W&B artifact."""
        # W&B takes letters, digits, dash, underscore and dot; a Gymnasium task has a colon.
        artifact = self._wandb.Artifact(re.sub(r"[^\w.-]", "_", name), type=kind)
        (artifact.add_dir if path.is_dir() else artifact.add_file)(str(path))
        self._run.log_artifact(artifact)

    def rewind(self, last: Mapping[str, int]) -> None:
        """Nothing to do: repeated rows are recognised by their index."""

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()

    def _start(self, options: WandbOptions, run_dir: Path, config: Mapping[str, Any], mode: str) -> Any:
        settings = {"silent": True, "console": "off", "init_timeout": 60.0, **options.settings}
        return self._wandb.init(
            project=options.project,
            entity=options.entity,
            group=options.group,
            name=options.name or run_dir.name,
            tags=list(options.tags) or None,
            job_type=options.job_type,
            config=dict(config),
            dir=str(run_dir),
            id=_wandb_id(run_dir),
            resume="allow",
            mode=mode,
            reinit="create_new",
            settings=self._wandb.Settings(**settings),
        )


class TensorboardMirror:
    """TensorBoard event files in ``<run_dir>/tensorboard/<stream>``."""

    name = "TensorBoard"

    def __init__(self, run_dir: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._make = SummaryWriter
        self._folder = run_dir / "tensorboard"
        self._writers: dict[str, Any] = {}
        self._purge: dict[str, int] = {}

    def log(self, stream: str, counters: Mapping[str, int], metrics: Mapping[str, Any], *, row: int) -> None:
        """Write every number of a row against its main counter."""
        if stream not in self._writers:
            purge = self._purge.pop(stream, None)
            self._writers[stream] = self._make(str(self._folder / stream), purge_step=purge)
        for key, value in metrics.items():
            if not isinstance(value, str):
                self._writers[stream].add_scalar(f"{stream}/{key}", value, counters[main_counter(counters)])

    def video(self, name: str, path: Path, counters: Mapping[str, int]) -> None:
        """Nothing: the file lies in the run directory."""

    def artifact(self, path: Path, *, name: str, kind: str) -> None:
        """Nothing: TensorBoard has no artifacts."""

    def rewind(self, last: Mapping[str, int]) -> None:
        """Hide what was written after the given counter values."""
        self.close()
        self._writers = {}
        self._purge = {stream: value + 1 for stream, value in last.items()}

    def close(self) -> None:
        """Flush and close the event files."""
        for writer in self._writers.values():
            writer.close()


def main_counter(counters: Mapping[str, int]) -> str:
    """Return the x-axis of a row: ``env_steps`` where there is one, else the first counter."""
    return "env_steps" if "env_steps" in counters else next(iter(counters))


def wandb_mode(asked: str) -> str:
    """Resolve ``"auto"`` without touching the network."""
    if asked != "auto":
        return asked
    if os.environ.get("WANDB_MODE"):
        return os.environ["WANDB_MODE"]
    return "online" if _is_logged_in() else "offline"


def _is_logged_in() -> bool:
    if os.environ.get("WANDB_API_KEY"):
        return True
    host = urlparse(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai")).hostname or ""
    path = Path(os.environ.get("NETRC", "~/.netrc")).expanduser()
    try:
        return host in netrc.netrc(str(path)).hosts
    except (OSError, netrc.NetrcParseError):
        return False


def _wandb_id(run_dir: Path) -> str:
    """The id of this directory's W&B run, drawn once and kept."""
    path = run_dir / WANDB_RUN_FILE
    try:
        return str(json.loads(path.read_text())["id"])
    except (OSError, ValueError, KeyError, TypeError):
        identity = uuid.uuid4().hex[:8]
        write_json(path, {"id": identity})
        return identity

"""A job is a ``crptpro`` command with a directory, ``ROOT/jobs/KEY``.

``job.json`` describes it, ``log.txt`` has the output of its command, and ``done.json`` of a finished job its cost. The
key ends in a hash of the command, which names needed jobs by their keys: experiments share equal jobs, and a changed
number makes another job. ``ROOT/experiments`` lists the jobs of each experiment.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crptpro.artifact import CARD_FILE, WEIGHTS_FILE, read_json, write_json
from crptpro.data.storage import PIXELS_FILE
from crptpro.directory_lock import locked
from crptpro.errors import RecordError
from crptpro.plugins import loaded_plugins
from crptpro.values import as_path

if TYPE_CHECKING:
    import pandas

JOBS, EXPERIMENTS = "jobs", "experiments"
DESCRIPTION, DONE, LOG, CLOCK, LOCK = "job.json", "done.json", "log.txt", "clock.json", ".job.lock"
KINDS = {
    "dataset": "datasets of random transitions",
    "untrained": "untrained encoders",
    "encoder": "encoders trained on datasets",
    "explored": "encoders trained while exploring",
    "finetuned": "fine-tuned encoders",
    "run": "downstream runs",
    "probe": "state probes",
    "timing": "timings, alone on the machine",
    "coverage": "coverage measurements",
    "embeddings": "embeddings",
}
"""Kinds of jobs in the order of tables, and their names there."""
OWN = "{out}"  # stands for the job's own directory in a command, ``{KEY}`` for that of a job it needs


@dataclass(frozen=True)
class Job:
    """One command, and its facts for tables."""

    kind: str  # of KINDS
    title: str  # a few readable words for the key
    command: tuple[str, ...]  # arguments of ``crptpro``, except for device, workers and plugins
    facts: Mapping[str, Any] = field(compare=False)  # plain values: method, domains, task, seed, updates
    needs: tuple[Job, ...] = field(default=(), compare=False)  # jobs that must be finished before
    definition: str = ""  # digest of the plugins that define names in the command, if any

    @cached_property
    def key(self) -> str:
        """Name of the job's directory."""
        identity = [*self.command, self.definition] if self.definition else list(self.command)
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:10]
        return f"{self.kind}-{re.sub(r'[^a-zA-Z0-9._]+', '-', self.title).strip('-')}-{digest}"

    @property
    def is_exclusive(self) -> bool:
        """Whether the job needs its machine to itself: it measures time."""
        return self.kind == "timing"


def plugins_digest() -> str:
    """Return a digest of the code of all plugins: an edited plugin makes new jobs."""
    paths = [name if name.endswith(".py") else sys.modules[name].__file__ for name in loaded_plugins()]
    return hashlib.sha256(b"".join(Path(path or "").read_bytes() for path in paths)).hexdigest()


def options(**values: Any) -> list[str]:
    """Return settings as options of a command, sorted by name; ``None`` and empty ones are left out.

    Examples:
        >>> options(batch_size=128, compile=False, loss={"num_prototypes": 16})
        ['--batch-size', '128', '--no-compile', '--loss', 'num_prototypes=16']
    """
    words: list[str] = []
    for name, value in sorted(values.items()):
        flag = name.replace("_", "-")
        if value is None or value in ((), {}):
            continue
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, Mapping):
            words += [f"--{flag}", *(f"{key}={each!r}" for key, each in sorted(value.items()))]
        else:
            words += [f"--{flag}", str(value)]
    return words


def directory_of(root: Path, key: str) -> Path:
    """Return the directory of a job."""
    return root / JOBS / key


def is_finished(root: Path, job: Job) -> bool:
    """Whether a job has been finished; its records stay even if its dataset or weights were removed."""
    return (directory_of(root, job.key) / DONE).is_file()


def _has_inputs(root: Path, job: Job, reader: Job) -> bool:
    """Whether the directories of a job that another job reads exist, with weights or pixels if they have a card."""
    names = re.findall(rf"\{{{re.escape(job.key)}\}}/([^\s'\"]*)", " ".join(reader.command))
    for path in (directory_of(root, job.key) / name for name in names):
        has_content = (path / WEIGHTS_FILE).exists() or (path / PIXELS_FILE).exists()
        if not (has_content if (path / CARD_FILE).exists() else path.exists()):
            return False
    return True


@dataclass(frozen=True)
class Plan:
    """All jobs of experiments without repeats, and those that have to run, in order."""

    jobs: tuple[Job, ...]
    missing: tuple[Job, ...]
    incomplete: tuple[Job, ...] = ()  # missing ones that were finished, but whose outputs were removed


def make_plan(wanted: Iterable[Job], root: Path) -> Plan:
    """Collect jobs and, recursively, the needs of unfinished ones.

    A finished job does not run again, even if its inputs were removed. An unfinished job needs its inputs: a job whose
    encoder was removed runs again.
    """
    finished: dict[str, Job] = {}
    missing: dict[str, Job] = {}

    def require(job: Job, reader: Job | None = None) -> None:
        if is_finished(root, job) and (reader is None or _has_inputs(root, job, reader)):
            finished[job.key] = job
        elif job.key not in missing:
            for needed in job.needs:
                require(needed, job)
            missing[job.key] = job

    for job in wanted:
        require(job)
    kept = [job for key, job in finished.items() if key not in missing]
    incomplete = tuple(job for job in missing.values() if is_finished(root, job))
    return Plan((*kept, *missing.values()), tuple(missing.values()), incomplete)


def describe(root: Path, plan: Plan) -> None:
    """Write ``job.json`` of every job, and empty the directory of a finished job that has to run again."""
    for job in plan.incomplete:
        if is_finished(root, job):  # otherwise another command has restarted it
            shutil.rmtree(directory_of(root, job.key))
    for job in plan.jobs:
        path = directory_of(root, job.key) / DESCRIPTION
        if not path.exists():
            needs = [needed.key for needed in job.needs]
            write_json(path, {"kind": job.kind, "command": job.command, "needs": needs, "facts": job.facts})


FRAME_BYTES = 3 * 84 * 84
INTERVAL = "checkpoint_interval_env_steps"  # replays on disk keep further frames, for the last two checkpoints
ENCODER_BYTES, CHECKPOINT_BYTES, AGENT_BYTES = 45_000_000, 200_000_000, 12_000_000
"""Sizes of an artifact with its heads, of the two checkpoints of a training, and of an agent."""


def bytes_of(job: Job) -> tuple[int, int]:
    """Estimate the disk space that a job leaves occupied, and the space that it needs in addition while it runs."""
    facts = job.facts
    if job.kind == "dataset":
        return facts["transitions"] * FRAME_BYTES, 0
    if job.kind in ("encoder", "finetuned"):
        return ENCODER_BYTES, CHECKPOINT_BYTES
    if job.kind == "explored":
        domains, interval = len(facts["domains"]), facts["explore"].get(INTERVAL, 5_000)
        kept = min(facts["decisions"], facts["replay_capacity"] * domains) * 51 // 50 + 2 * interval + 2_500 * domains
        return ENCODER_BYTES + kept * FRAME_BYTES, CHECKPOINT_BYTES * (1 + len(facts["domains"]))
    if job.kind == "run":
        frames = facts["replay_capacity"] * 51 // 50 + facts.get(INTERVAL, 5_000) + 3_500
        return AGENT_BYTES, CHECKPOINT_BYTES + frames * FRAME_BYTES
    return 1_000_000, 0


CELLS = ("experiment", "scale", "cells")  # keys of a file of cells


def write_cells(root: Path, experiment: str, scale: str, cells: Iterable[tuple[str, str, Mapping[str, Any]]]) -> None:
    """Record the cells of an experiment: label, key of the job and place of each number.

    They are added to earlier cells, and replace those with the same label and place. An earlier file that cannot be
    read raises a ``RecordError``.
    """
    path = root / EXPERIMENTS / f"{experiment}-{scale}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    new = [{"label": label, "job": key, "place": place} for label, key, place in cells]
    with locked(path.parent / ".lock"):
        before = read_json(path, keys=CELLS, error=RecordError)["cells"] if path.exists() else []
        taken = [(cell["label"], cell["place"]) for cell in new]
        kept = [cell for cell in before if (cell["label"], cell["place"]) not in taken]
        write_json(path, {"experiment": experiment, "scale": scale, "cells": [*new, *kept]})


@dataclass(frozen=True)
class Results:
    """The state of a reproduction.

    ``cells`` has a row per number of an experiment: ``experiment``, ``scale``, ``label``, ``job`` (a key), ``done``,
    and a column per name of a place, such as ``group``, ``task``, ``encoder_seed``, ``seed``. ``jobs`` has by key
    ``kind``, ``command``, ``facts``, ``needs``, ``seconds``, ``attempts``, ``threads``, ``device``, ``git_revision``,
    ``versions``, ``path``, ``done`` and ``machine``.
    """

    cells: pandas.DataFrame
    jobs: pandas.DataFrame


DESCRIBED = ("kind", "command", "facts", "needs")  # keys of ``job.json`` that tables read
MADE = ("seconds", "attempts", "threads", "device", "git_revision", "versions")  # of ``done.json``, with ``hardware``


def load_results(root: str | Path) -> Results:
    """Read the cells of experiments, and their jobs, from the directory of a reproduction.

    A damaged record raises a ``RecordError``.
    """
    import pandas as pd

    root = as_path(root, "root")
    rows = {path.parent.name: _job_row(path) for path in sorted((root / JOBS).glob(f"*/{DESCRIPTION}"))}
    cells = []
    for path in sorted((root / EXPERIMENTS).glob("*.json")):
        content = read_json(path, keys=CELLS, error=RecordError)
        for cell in content["cells"]:
            row = {"experiment": content["experiment"], "scale": content["scale"]}
            row |= {"label": cell["label"], "job": cell["job"]}
            cells.append({**row, "done": rows.get(row["job"], {}).get("done", False), **cell["place"]})
    columns = None if cells else ["experiment", "scale", "label", "job", "done"]
    table = pd.DataFrame(cells, columns=columns, dtype=object).astype({"done": bool})
    jobs = pd.DataFrame.from_dict(rows, orient="index", columns=[*DESCRIBED, *MADE, "path", "done", "machine"])
    return Results(table, jobs.astype({"done": bool}).rename_axis("key"))


def _job_row(path: Path) -> dict[str, Any]:
    content, done_path = read_json(path, keys=DESCRIBED, error=RecordError), path.with_name(DONE)
    done = read_json(done_path, error=RecordError) if done_path.exists() else {}
    made = {name: done.get(name) for name in MADE} | {"machine": machine(done.get("hardware"))}
    return {name: content[name] for name in DESCRIBED} | made | {"path": path.parent, "done": done_path.exists()}


def machine(hardware: Mapping[str, Any] | None) -> str:
    """Describe the hardware of a record; empty if none is recorded."""
    if not hardware:
        return ""
    instructions = f" ({hardware['cpu_instructions']})" if hardware.get("cpu_instructions") else ""
    cores = f"{hardware.get('cpu')}{instructions}, {hardware.get('cpu_cores')} cores"
    ram = float(hardware.get("ram_bytes") or 0) / 2**30
    return f"{cores}, {ram:.0f} GiB, {', '.join(hardware.get('gpus') or ()) or 'no GPU'}"

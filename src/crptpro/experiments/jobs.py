"""A job is a ``crptpro`` command with a directory: its key, what it needs, what there is to do, and its results.

The directory of a job is ``ROOT/jobs/KEY``. ``job.json`` describes it, ``log.txt`` holds what its command printed,
``done.json`` says that it is finished and what it took; the command's own records lie beside them. The key ends in a
hash of the command, which names the directories of needed jobs by their keys. So experiments share whatever they
have in common, and a changed number makes another job. ``ROOT/experiments`` says which jobs an experiment asked for.
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

from filelock import FileLock

from crptpro.artifact import WEIGHTS_FILE, read_json, write_json
from crptpro.data.storage import PIXELS_FILE
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
    "prototypes": "prototype measurements",
    "coverage": "coverage measurements",
    "embeddings": "embeddings",
}
"""Kinds of jobs in the order of tables, and what they are called there."""
OWN = "{out}"
"""Stands for the job's own directory in a command; ``{KEY}`` for that of a job it needs."""


@dataclass(frozen=True)
class Job:
    """One command, and what tables have to know of it.

    Args:
        kind: of :data:`KINDS`.
        title: a few readable words for the key.
        command: arguments of ``crptpro``, without those that say where and how it runs.
        facts: plain values that tables need: method, domains, task, seed, updates.
        needs: jobs that must be finished before.
        definition: digest of the plugins that its command's names come from; empty for those of the library.
    """

    kind: str
    title: str
    command: tuple[str, ...]
    facts: Mapping[str, Any] = field(compare=False)
    needs: tuple[Job, ...] = field(default=(), compare=False)
    definition: str = ""

    @cached_property
    def key(self) -> str:
        """Name of the job's directory."""
        identity = [*self.command, self.definition] if self.definition else list(self.command)
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:10]
        return f"{self.kind}-{re.sub(r'[^a-zA-Z0-9._]+', '-', self.title).strip('-')}-{digest}"

    @property
    def is_exclusive(self) -> bool:
        """Whether nothing else may run on its machine: it measures time."""
        return self.kind == "timing"


def plugins_digest() -> str:
    """Return a digest of the code of all plugins: an edited one makes new jobs instead of reusing old results."""
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


# --- what there is, and what there is to do --------------------------------------------------------------------------


def directory_of(root: Path, key: str) -> Path:
    """Return the directory of a job."""
    return root / JOBS / key


def is_finished(root: Path, job: Job) -> bool:
    """Whether a job has been finished; its dataset or weights may have been removed since, its records stay."""
    return (directory_of(root, job.key) / DONE).is_file()


def _has_what(root: Path, job: Job, reader: Job) -> bool:
    """Whether the directories of a job that another one's command names are there."""
    named = re.findall(rf"\{{{re.escape(job.key)}\}}/([^\s'\"]*)", " ".join(reader.command))
    for path in (directory_of(root, job.key) / name for name in named):
        is_slim = (path / "card.json").exists() and not any(
            (path / f).exists() for f in (WEIGHTS_FILE, PIXELS_FILE)
        )
        if is_slim or not path.exists():
            return False
    return True


@dataclass(frozen=True)
class Plan:
    """What experiments need.

    Args:
        jobs: without repeats, each after all that it needs.
        missing: those that have to run, in order.
        emptied: those of them that were finished, but whose dataset or weights are gone.
    """

    jobs: tuple[Job, ...]
    missing: tuple[Job, ...]
    emptied: tuple[Job, ...] = ()


def make_plan(wanted: Iterable[Job], root: Path) -> Plan:
    """Collect jobs and, recursively, what those need that are not finished.

    A finished job is left alone, whatever has become of what it needed. What an unfinished one reads must be there: a
    job whose encoder was removed since runs again.

    Args:
        wanted: jobs that experiments ask for.
        root: where finished ones are found.
    """
    there: dict[str, Job] = {}
    missing: dict[str, Job] = {}

    def require(job: Job, reader: Job | None = None) -> None:
        if is_finished(root, job) and (reader is None or _has_what(root, job, reader)):
            there[job.key] = job
        elif job.key not in missing:
            for needed in job.needs:
                require(needed, job)
            missing[job.key] = job

    for job in wanted:
        require(job)
    kept = [job for key, job in there.items() if key not in missing]
    emptied = tuple(job for job in missing.values() if is_finished(root, job))
    return Plan((*kept, *missing.values()), tuple(missing.values()), emptied)


def describe(root: Path, plan: Plan) -> None:
    """Write ``job.json`` of every job; one that has to run again loses what it had."""
    for job in plan.emptied:
        with FileLock(directory_of(root, job.key) / LOCK):
            for entry in directory_of(root, job.key).iterdir():
                if entry.is_dir():
                    shutil.rmtree(entry)
                elif entry.name != LOCK:
                    entry.unlink()
    for job in plan.jobs:
        path = directory_of(root, job.key) / DESCRIPTION
        if not path.exists():
            needs = [needed.key for needed in job.needs]
            about = {"kind": job.kind, "command": list(job.command), "needs": needs, "facts": dict(job.facts)}
            write_json(path, about)


def write_cells(
    root: Path,
    experiment: str,
    scale: str,
    request: Mapping[str, Any],
    cells: Iterable[tuple[str, str, Mapping]],
) -> None:
    """Write down what an experiment asks for: it is added to what was asked for before, or takes its place.

    Args:
        root: of the reproduction.
        experiment: its name.
        scale: name of the scale.
        request: which part of the experiment.
        cells: label, key of the job and place of each.

    Raises:
        RecordError: the file is there and cannot be read.
    """
    path = root / EXPERIMENTS / f"{experiment}-{scale}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    new = [{"label": label, "job": key, "place": dict(place)} for label, key, place in cells]
    with FileLock(path.parent / ".lock"):
        before = read_json(path, error=RecordError).get("cells", []) if path.exists() else []
        taken = [(cell["label"], cell["place"]) for cell in new]
        kept = [cell for cell in before if (cell["label"], cell["place"]) not in taken]
        content = {"experiment": experiment, "scale": scale, "request": dict(request), "cells": [*new, *kept]}
        write_json(path, content)


FRAME_BYTES = 3 * 84 * 84
ENCODER_BYTES, CHECKPOINT_BYTES, AGENT_BYTES = 45_000_000, 200_000_000, 12_000_000
"""Of an artifact with its heads; of the two checkpoints that a training keeps; of an agent."""


def bytes_of(job: Job) -> tuple[int, int]:
    """Return what a job leaves on the disk, about, and what it takes besides while it runs."""
    facts = job.facts
    if job.kind == "dataset":
        return facts["transitions"] * FRAME_BYTES, 0
    if job.kind in ("encoder", "finetuned"):
        return ENCODER_BYTES, CHECKPOINT_BYTES
    if job.kind == "explored":
        kept = min(facts["decisions"], 100_000 * len(facts["domains"]))
        return ENCODER_BYTES + kept * FRAME_BYTES, CHECKPOINT_BYTES * (1 + len(facts["domains"]))
    if job.kind == "run":
        usual = 100_000 if facts["method"].startswith(("drq", "proto-rl")) else 40_000
        return AGENT_BYTES, CHECKPOINT_BYTES + facts.get("replay_capacity", usual) * FRAME_BYTES
    return 1_000_000, 0


@dataclass(frozen=True)
class Results:
    """What a reproduction has so far.

    Args:
        cells: a row per number that an experiment asks for: ``experiment``, ``scale``, ``label``, ``job`` (a key),
            ``done``, and a column per name of a place, such as ``group``, ``task``, ``encoder_seed``, ``seed``.
        jobs: by key: ``kind``, ``path``, ``done``, ``seconds``, ``attempts``, ``threads``, ``device``, ``machine``,
            ``git_revision``, ``versions``, ``facts``, ``needs``.
    """

    cells: pandas.DataFrame
    jobs: pandas.DataFrame


MADE = ("seconds", "attempts", "threads", "device", "git_revision", "versions")
"""What ``done.json`` has besides the hardware."""
JOB_COLUMNS = ("kind", "facts", "needs", "path", "done", "machine", *MADE)
CELL_COLUMNS = ("experiment", "scale", "label", "job", "done")


def load_results(root: str | Path) -> Results:
    """Read what experiments asked for and what was made of it.

    Args:
        root: directory of a reproduction.

    Raises:
        RecordError: a record is damaged.
    """
    import pandas as pd

    root = as_path(root, "root")
    rows = {path.parent.name: _job_row(path) for path in sorted((root / JOBS).glob(f"*/{DESCRIPTION}"))}
    cells = []
    for path in sorted((root / EXPERIMENTS).glob("*.json")):
        content = read_json(path, error=RecordError)
        try:
            for cell in content["cells"]:
                about = {name: content[name] for name in ("experiment", "scale")}
                about |= {"label": cell["label"], "job": cell["job"]}
                cells.append(about | {"done": rows.get(cell["job"], {}).get("done", False)} | cell["place"])
        except (KeyError, TypeError, AttributeError) as reason:
            raise RecordError(f"{path} does not say what was asked for ({reason!r}); remove it.") from None
    jobs = pd.DataFrame.from_dict(rows, orient="index", columns=list(JOB_COLUMNS))
    table = pd.DataFrame(cells, dtype=object, columns=None if cells else list(CELL_COLUMNS))
    return Results(table.astype({"done": bool}), jobs.rename_axis("key"))


def _job_row(path: Path) -> dict[str, Any]:
    content, done_path = read_json(path, error=RecordError), path.with_name(DONE)
    done = read_json(done_path, error=RecordError) if done_path.exists() else {}
    row = {name: content.get(name) for name in ("kind", "facts", "needs")}
    row |= {"path": path.parent, "done": done_path.exists(), "machine": machine(done.get("hardware") or {})}
    return row | {name: done.get(name) for name in MADE}


def machine(hardware: Mapping[str, Any]) -> str:
    """Return the hardware of a record in words; empty where none is recorded."""
    if not hardware:
        return ""
    instructions = f" ({there})" if (there := hardware.get("cpu_instructions")) else ""
    cores = f"{hardware.get('cpu')}{instructions}, {hardware.get('cpu_cores')} cores"
    ram = float(hardware.get("ram_bytes") or 0) / 2**30
    return f"{cores}, {ram:.0f} GiB, {', '.join(hardware.get('gpus') or ()) or 'no GPU'}"

"""A job is a ``crptpro`` command with a directory: its key, what it needs, what there is to do, and its results.

The directory of a job is ``ROOT/jobs/KEY``. ``job.json`` describes it, ``log.txt`` holds what its command said,
``done.json`` says that it is finished and what it took; the command's own records lie beside them. The key ends in a
hash of the command, which names the directories of needed jobs by their keys. So experiments share whatever they
have in common, and a changed number makes another job. ``ROOT/experiments`` says which jobs an experiment asked for.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from crptpro.artifact import WEIGHTS_FILE, read_json, write_json
from crptpro.data.storage import PIXELS_FILE
from crptpro.domains import get_domain
from crptpro.errors import CRPTproError, RecordError
from crptpro.objectives import Method
from crptpro.values import as_path

if TYPE_CHECKING:
    import pandas

    from crptpro.training.explore import ExplorationPlan

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
_PLACEHOLDER = re.compile(r"\{([\w.+-]+)\}")


@dataclass(frozen=True)
class Job:
    """One command, and what tables have to know of it.

    Args:
        kind: of :data:`KINDS`.
        title: a few readable words for the key.
        command: arguments of ``crptpro``, without those that say where and how it runs.
        facts: plain values that tables need: method, domains, task, seed, updates.
        needs: jobs that must be finished before.
        definition: what a user's own method or domain was registered with, as JSON.
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

    def description(self) -> dict[str, Any]:
        """Return the content of ``job.json``."""
        return {
            "kind": self.kind,
            "command": list(self.command),
            "needs": [needed.key for needed in self.needs],
            "facts": dict(self.facts),
        }


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
        elif isinstance(value, (tuple, list)):
            words += [f"--{flag}", *map(str, value)]
        else:
            words += [f"--{flag}", str(value)]
    return words


def collect_job(domain: str, transitions: int, seed: int, *, quality: str = "exact") -> Job:
    """Return the collection of random transitions, in ``<job>/<domain>``."""
    found = get_domain(domain)
    command = ["collect", found.name, "--out", OWN]
    command += options(transitions=transitions, seed=seed, quality=None if quality == "exact" else quality)
    facts = {"domain": found.name, "transitions": transitions, "seed": seed, "quality": quality}
    title = f"{found.name} seed {seed}"
    return Job("dataset", title, tuple(command), facts, definition=domain_definition(found.name))


def pretrain_job(
    method: Method,
    datasets: Sequence[Job],
    seed: int,
    *,
    updates: int,
    training: Mapping[str, Any] | None = None,
    loss: Mapping[str, Any] | None = None,
    encoder: Mapping[str, Any] | None = None,
    snapshots: Sequence[int] = (),
) -> Job:
    """Return the training of an encoder on datasets, in ``<job>/encoder``."""
    domains = [dataset.facts["domain"] for dataset in datasets]
    command = ["pretrain", *map(dataset_of, datasets), "--method", method.name, "--out", OWN]
    settings = {"loss": dict(loss or {}), "encoder": dict(encoder or {}), **dict(training or {})}
    command += options(seed=seed, updates=updates, snapshots=tuple(snapshots), **settings)
    facts = {"method": method.name, "domains": domains, "seed": seed, "updates": updates, **settings}
    facts["snapshots"] = list(snapshots)
    facts["transitions"] = datasets[0].facts["transitions"]
    title = f"{method.name} {'+'.join(domains)} seed {seed}"
    return Job("encoder", title, tuple(command), facts, tuple(datasets), method_definition(method))


def explore_job(
    method: Method,
    domains: Sequence[str],
    seed: int,
    *,
    explore: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
    loss: Mapping[str, Any] | None = None,
) -> Job:
    """Return the training of an encoder on what its own agents see, in ``<job>/encoder`` and ``<job>/replay``."""
    names = [get_domain(domain).name for domain in domains]
    explore, settings = dict(explore or {}), {"loss": dict(loss or {}), **dict(training or {})}
    command = ["pretrain", *names, "--method", method.name, "--out", OWN]
    command += options(seed=seed, **settings, **explore)
    facts = {"method": method.name, "domains": names, "seed": seed, "explore": explore, **settings}
    plan = exploration_plan(method, names, explore)
    facts |= {"env_steps": plan.env_steps, "decisions": plan.decisions, "updates": plan.encoder_updates}
    title = f"{method.name} {'+'.join(names)} seed {seed}"
    definition = "".join([method_definition(method), *map(domain_definition, names)])
    return Job("explored", title, tuple(command), facts, (), definition)


def untrained_job(seed: int) -> Job:
    """Return the control, an encoder at its initialisation, in ``<job>/encoder``."""
    command = ("pretrain", "--method", "random-encoder", "--out", OWN, "--seed", str(seed))
    return Job("untrained", f"seed {seed}", command, {"method": "random-encoder", "seed": seed})


def finetune_job(
    base: Job, dataset: Job, seed: int, *, updates: int, training: Mapping[str, Any] | None = None
) -> Job:
    """Return an encoder's further training on one domain, in ``<job>/encoder``."""
    domain, method, training = dataset.facts["domain"], "crptpro-finetune", dict(training or {})
    command = ["finetune", encoder_of(base), dataset_of(dataset), "--out", OWN]
    command += options(seed=seed, updates=updates, **training)
    facts = {"method": method, "domains": [domain], "seed": seed, "updates": updates, "base": base.key}
    title = f"{method} on {domain} seed {seed}"
    return Job("finetuned", title, tuple(command), {**facts, **training}, (base, dataset))


def downstream_job(
    task: str, encoder: Job | None, seed: int, *, config: Mapping[str, Any] | None = None, name: str = ""
) -> Job:
    """Return reinforcement learning of a task; the job's directory is the run directory.

    Args:
        task: what is learned.
        encoder: the frozen encoder; ``None`` for DrQ, which trains its own.
        seed: second of the two seed levels; runs of several tasks with one seed have nothing else in common.
        config: settings that differ from the algorithm's.
        name: of the system, where the encoder's method does not say it.
    """
    from crptpro.seeding import derive_seed

    config, facts = dict(config or {}), {} if encoder is None else encoder.facts
    method = name or facts.get("method", "drq")
    command = ["downstream", task, "--pretrained", "drq" if encoder is None else encoder_of(encoder)]
    command += ["--out", OWN, *options(seed=derive_seed(seed, "task", task), **config)]
    about = {"method": method, "task": task, "domain": get_domain(task).name, "seed": seed}
    about |= {"encoder_seed": facts.get("seed"), "colors": "normal", **config}
    about.setdefault("env_steps", 1_000_000 if encoder is None else 500_000)
    colors = "" if about["colors"] == "normal" else f" {about['colors']}"
    by = "" if encoder is None else f" encoder {facts['seed']}"
    title = f"{task}{colors} {method}{by} seed {seed}"
    needs = () if encoder is None else (encoder,)
    return Job("run", title, tuple(command), about, needs, domain_definition(task))


def probe_job(
    encoder: Job, dataset: Job, *, samples: int = 2_000, seed: int = 0, at_updates: int | None = None
) -> Job:
    """Return the state probe of an encoder on a domain, ``<job>/probe.csv``; of a snapshot if `at_updates` says so."""
    command = ["probe", encoder_of(encoder, at_updates), dataset_of(dataset), "--csv", f"{OWN}/probe.csv"]
    command += options(samples=samples, seed=seed)
    domain, method = dataset.facts["domain"], encoder.facts["method"]
    facts = {"method": method, "encoder_seed": encoder.facts["seed"], "domain": domain, "colors": "normal"}
    facts |= {"samples": samples, "seed": seed, "at_updates": at_updates}
    when = "" if at_updates is None else f" at {at_updates}"
    title = f"{method} seed {encoder.facts['seed']}{when} on {domain}"
    return Job("probe", title, tuple(command), facts, (encoder, dataset))


def prototypes_job(encoder: Job) -> Job:
    """Return how far an encoder's prototypes have spread, along its training and at its end."""
    command = ("measure", "prototypes", encoder_of(encoder), "--out", OWN)
    facts = {name: encoder.facts[name] for name in ("method", "domains", "seed")}
    title = f"{facts['method']} {'+'.join(facts['domains'])} seed {facts['seed']}"
    return Job("prototypes", title, command, facts, (encoder,))


def comparison_job(
    kind: str, encoder: Job, explorer: Job, datasets: Sequence[Job], *, samples: int, seed: int
) -> Job:
    """Return what compares an explorer's data with random data: ``coverage`` or ``embeddings``.

    Args:
        kind: which of the two.
        encoder: which embeds all observations.
        explorer: whose replays are read.
        datasets: of random transitions.
        samples: observations of each source.
        seed: of the draw.
    """
    replays = [f"{{{explorer.key}}}/replay/{domain}" for domain in explorer.facts["domains"]]
    command = ["measure", kind, "--encoder", encoder_of(encoder), "--explorer", encoder_of(explorer)]
    command += ["--replays", *replays, "--datasets", *map(dataset_of, datasets), "--out", OWN]
    command += options(samples=samples, seed=seed)
    facts = {name: explorer.facts[name] for name in ("method", "domains", "seed")} | {"samples": samples}
    title = f"{facts['method']} {'+'.join(facts['domains'])} seed {facts['seed']}"
    needs = tuple(dict.fromkeys((encoder, explorer, *datasets)))
    return Job(kind, title, tuple(command), facts, needs)


def timing_job(
    encoders: Sequence[Job],
    paper: Sequence[Job],
    *,
    updates: int,
    paper_updates: int,
    device: str,
    threads: int,
) -> Job:
    """Return the timing of encoders' training, ``<job>/timing.csv``; device and threads are what it measures on.

    Args:
        encoders: one, or of a method that has an encoder per domain several, whose costs add up.
        paper: the same, trained as the paper does.
        updates: encoder updates that are timed, after as many to warm up.
        paper_updates: the same with the paper's batches and intervals; 0 leaves those hours open.
        device: of networks.
        threads: of torch.
    """
    command = ["measure", "timing", "--out", OWN]
    command += options(updates=updates, paper_updates=paper_updates, device=device, threads=threads)
    for trained, whole in zip(encoders, paper, strict=True):
        command += [
            "--training",
            _shortened(trained, trained),
            "--paper-training",
            _shortened(whole, trained),
        ]
    domains = [domain for job in encoders for domain in job.facts["domains"]]
    facts = {"method": encoders[0].facts["method"], "domains": domains, "seed": encoders[0].facts["seed"]}
    facts |= {"device": device, "threads": threads}
    title = f"{facts['method']} {'+'.join(domains)} {device} {threads}"
    needs = tuple(dict.fromkeys(needed for job in encoders for needed in job.needs))
    return Job("timing", title, tuple(command), facts, needs)


def encoder_of(job: Job, at_updates: int | None = None) -> str:
    """Return an encoder's directory as a command names it, or that of one of its snapshots."""
    return f"{{{job.key}}}/encoder" + ("" if at_updates is None else f"_at_{at_updates}")


def dataset_of(job: Job) -> str:
    """Return a dataset's directory as a command names it."""
    directory = re.sub(r"[^\w.+-]+", "-", job.facts["domain"])
    return f"{{{job.key}}}/{directory}"


def _shortened(job: Job, like: Job) -> str:
    """Return a training as one word, on the data of another: what is in the data does not change the time."""
    command = list(job.command)
    if job.needs:
        command[1 : 1 + len(job.needs)] = map(dataset_of, like.needs)
    at = command.index("--out")
    return shlex.join(command[:at] + command[at + 2 :])


def exploration_plan(method: Method, domains: Sequence[str], explore: Mapping[str, Any]) -> ExplorationPlan:
    """Return how often a method that explores decides and updates.

    Raises:
        CRPTproError: for a budget that ends before the first update.
    """
    from crptpro.training.explore import ExploreConfig, plan_exploration

    return plan_exploration(method, domains, ExploreConfig(**explore))


def method_definition(method: Method) -> str:
    """Return what a user's own method was registered with; empty for those of the library.

    It is part of the keys of jobs: an edited plugin makes new jobs instead of reusing old results.
    """
    return "" if method.is_builtin else _as_json(method.describe(), f"method {method.name!r}")


def domain_definition(name: str) -> str:
    """Return what a user's own domain was registered with; empty for dm_control's and Gymnasium's."""
    domain = get_domain(name)
    if domain.source != "own":
        return ""
    values = {each.name: getattr(domain, each.name) for each in dataclasses.fields(domain)}
    return _as_json(values, f"domain {domain.name!r}")


def _as_json(content: Mapping[str, Any], whose: str) -> str:
    def in_words(value: Any) -> Any:
        if isinstance(value, functools.partial):
            return {"partial": value.func, "args": list(value.args), "keywords": value.keywords}
        if callable(value) and hasattr(value, "__qualname__"):
            return f"{value.__module__}.{value.__qualname__}"
        text = repr(value)
        if re.search(r"\bat 0x[0-9a-f]+", text):
            raise CRPTproError(
                f"The {whose} was registered with {text}, whose name differs in every process, so that nothing made "
                "with it would be found again. Use plain values, functions or classes, or give it a __repr__."
            )
        return text

    return json.dumps(content, sort_keys=True, default=in_words)


# --- what there is, and what there is to do --------------------------------------------------------------------------


def directory_of(root: Path, key: str) -> Path:
    """Return the directory of a job."""
    return root / JOBS / key


def is_finished(root: Path, job: Job) -> bool:
    """Whether a job has been finished; what it made for others may have been removed since, its records stay."""
    return (directory_of(root, job.key) / DONE).is_file()


def has_what(root: Path, job: Job, reader: Job) -> bool:
    """Whether a finished job still has the directories that another one's command names."""
    named = [word for part in reader.command for word in re.findall(r"\{[\w.+-]+\}[^\s'\"]*", part)]
    paths = [directory_of(root, job.key) / word.partition("/")[2] for word in named if job.key in word]
    return is_finished(root, job) and all(map(_is_there, paths))


def _is_there(path: Path) -> bool:
    """Of a dataset or an encoder the card belongs to the records; what others read may be gone."""
    if (path / "card.json").exists():
        return any((path / name).exists() for name in (WEIGHTS_FILE, PIXELS_FILE))
    return path.exists()


@dataclass(frozen=True)
class Plan:
    """What experiments need.

    Args:
        jobs: without repeats, each after all that it needs.
        missing: those that have to run, in order.
    """

    jobs: tuple[Job, ...]
    missing: tuple[Job, ...]


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
        if is_finished(root, job) and (reader is None or has_what(root, job, reader)):
            there[job.key] = job
        elif job.key not in missing:
            for needed in job.needs:
                require(needed, job)
            missing[job.key] = job

    for job in wanted:
        require(job)
    kept = [job for key, job in there.items() if key not in missing]
    return Plan((*kept, *missing.values()), tuple(missing.values()))


def describe(root: Path, plan: Plan) -> None:
    """Write ``job.json`` of every job; one that has to run again is emptied."""
    for job in plan.jobs:
        path = directory_of(root, job.key) / DESCRIPTION
        if not path.exists():
            write_json(path, job.description())
    readers = [(job, reader) for reader in plan.missing for job in reader.needs]
    for job in plan.missing:
        # Finished, but without what a reader needs of it; otherwise another command has finished it since.
        lacks = any(needed == job and not has_what(root, job, reader) for needed, reader in readers)
        if is_finished(root, job) and lacks:
            with FileLock(directory_of(root, job.key) / LOCK):
                for entry in directory_of(root, job.key).iterdir():
                    if entry.is_dir():
                        shutil.rmtree(entry)
                    elif entry.name not in (DESCRIPTION, LOCK):
                        entry.unlink()


def write_cells(
    root: Path,
    experiment: str,
    scale: str,
    request: Mapping[str, Any],
    cells: Iterable[tuple[str, str, Mapping]],
) -> None:
    """Write down what an experiment asks for, without losing what it asked for before.

    What is asked for takes the place of what stood there: a method that has other numbers since is another job, and a
    table that had both would average them.

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
"""Of an artifact with its heads; of the two checkpoints of an encoder, or of an agent, that a training keeps; of an
agent."""


def bytes_of(job: Job) -> tuple[int, int]:
    """Return what a job leaves on the disk, about, and what it takes besides while it runs."""
    facts = job.facts
    if job.kind == "dataset":
        return facts["transitions"] * FRAME_BYTES, 0
    if job.kind in ("encoder", "finetuned"):
        return ENCODER_BYTES * (1 + len(facts.get("snapshots", ()))), CHECKPOINT_BYTES
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


JOB_COLUMNS = (
    "kind", "path", "done", "seconds", "attempts", "threads", "device", "machine", "git_revision", "versions",
    "facts", "needs",
)  # fmt: skip
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
            about = {"experiment": content["experiment"], "scale": content["scale"]}
            for cell in content["cells"]:
                done = rows.get(cell["job"], {}).get("done", False)
                cells.append(
                    {**about, "label": cell["label"], "job": cell["job"], "done": done, **cell["place"]}
                )
        except (KeyError, TypeError, AttributeError) as reason:
            raise RecordError(f"{path} does not say what was asked for ({reason!r}); remove it.") from None
    jobs = pd.DataFrame.from_dict(rows, orient="index", columns=list(JOB_COLUMNS))
    table = pd.DataFrame(cells, dtype=object, columns=None if cells else list(CELL_COLUMNS))
    return Results(table.astype({"done": bool}), jobs.rename_axis("key"))


def _job_row(path: Path) -> dict[str, Any]:
    content, done_path = read_json(path, error=RecordError), path.with_name(DONE)
    done = read_json(done_path, error=RecordError) if done_path.exists() else None
    row: dict[str, Any] = {name: content.get(name) for name in ("kind", "facts", "needs")}
    row |= {
        "path": path.parent,
        "done": done is not None,
        "machine": machine((done or {}).get("hardware") or {}),
    }
    names = ("seconds", "attempts", "threads", "device", "git_revision", "versions")
    return row | {name: (done or {}).get(name) for name in names}


def machine(hardware: Mapping[str, Any]) -> str:
    """Return the hardware of a record in words; empty where none is recorded."""
    if not hardware:
        return ""
    instructions = f" ({there})" if (there := hardware.get("cpu_instructions")) else ""
    cores = f"{hardware.get('cpu')}{instructions}, {hardware.get('cpu_cores')} cores"
    ram = float(hardware.get("ram_bytes") or 0) / 2**30
    return f"{cores}, {ram:.0f} GiB, {', '.join(hardware.get('gpus') or ()) or 'no GPU'}"

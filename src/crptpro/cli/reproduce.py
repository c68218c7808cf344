"""``crptpro reproduce``: an experiment of the paper, at a scale that can be afforded."""

from __future__ import annotations

import dataclasses
import difflib
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from crptpro.errors import CRPTproError, UnknownNameError

if TYPE_CHECKING:
    from crptpro.experiments.jobs import Job, Plan
    from crptpro.experiments.launch import Failure, Launcher, Resources
    from crptpro.experiments.matrix import Cell, Request

ALL = "all"
_ITS_OWN = arg(help_behavior_hint="(default: the experiment's)")
_READ_BY = {
    "partition": ("slurm",), "hours": ("slurm",), "memory_gb": ("slurm",), "sbatch": ("slurm",),
    "ray_address": ("ray",), "jobs_per_gpu": ("local", "ray"),
}  # fmt: skip
PAPER_RUNS = 6
"""Evaluations behind each of the paper's numbers: three runs on each of two encoders."""


@dataclass(frozen=True)
class Reproduce:
    """Reproduce an experiment of the paper: print the plan, then run whatever job is missing.

    Experiments: seen, unseen, colors, finetune, efficiency, ablation, sensitivity, prototypes, coverage, stability,
    visualize, probe, study, or all. Whatever is finished, by this or another experiment, is used again; interrupted,
    the same command continues. At the end `crptpro report ROOT` makes tables and figures of it. The default of at most
    three runs on one encoder is below the paper's six evaluations of each number: --encoder-seeds 0 1 has as many.
    """

    experiments: Annotated[
        Positional[tuple[str, ...]],
        arg(metavar="EXPERIMENT [EXPERIMENT ...]", help_behavior_hint="(required)"),
    ]
    """which, e.g. `seen`, or several, or `all`"""
    scale: Literal["tiny", "small", "paper"]
    """tiny shows in minutes that everything runs; small fits two CPU cores; paper has the paper's numbers"""
    methods: Annotated[tuple[str, ...], _ITS_OWN] = ()
    """only these systems, e.g. `crptpro drq random-encoder`"""
    groups: Annotated[tuple[str, ...], _ITS_OWN] = ()
    """only these pre-training groups, of A B C D"""
    tasks: Annotated[tuple[str, ...], _ITS_OWN] = ()
    """only these tasks, e.g. `walker_run`"""
    seeds: Annotated[
        tuple[int, ...], arg(help_behavior_hint="(default: as many as the scale has, from 0)")
    ] = ()
    """of downstream runs on each encoder"""
    encoder_seeds: tuple[int, ...] = (0,)
    """of data and pre-training"""
    colors_by: Literal["background", "image"] = "background"
    """what other colours are, where an experiment has them: reversed in the background or in the whole image"""
    out: Annotated[str, arg(metavar="PATH")] = "runs/reproduce"
    """ROOT, where everything is kept and found again"""
    dry_run: bool = False
    """print the plan and run nothing"""
    device: str = "cpu"
    """of networks: cpu, cuda (jobs share this machine's GPUs, or have one of the cluster's), or cuda:1"""
    launcher: Literal["local", "slurm", "ray", "inline"] = "local"
    """local: processes here; slurm, ray: a cluster whose nodes share ROOT; inline: in this process, one at a time"""
    jobs: int | None = None
    """most jobs at a time, each with its own memory (default: one per core, or as many as the GPUs take by
    --jobs-per-gpu, which is also the most here; on a cluster 16)"""
    cores_per_job: int | None = None
    """cores of each job (default: this machine's divided by jobs; on a cluster 1, beside a GPU 4)"""
    jobs_per_gpu: int = 1
    """local, ray: how many jobs share a GPU"""
    attempts: int = 3
    """how often a job is tried before it counts as failed; each attempt continues the one before"""
    partition: str | None = None
    """slurm: partition (default: the cluster's)"""
    hours: float = 24.0
    """slurm: time limit of a job; one that reaches it is queued again and continues"""
    memory_gb: float = 16.0
    """slurm: memory of a job"""
    sbatch: Annotated[tuple[str, ...], arg(help_behavior_hint="(default: none)")] = ()
    """slurm: further options as `key=value`, e.g. `account=robots qos=high`"""
    ray_address: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """ray: head of the cluster (default: RAY_ADDRESS, or one on this machine)"""

    def run(self) -> None:
        """Print the plan, run what is missing, list what failed."""
        from crptpro.artifact import require_disk
        from crptpro.experiments.jobs import bytes_of, make_plan, write_cells
        from crptpro.experiments.launch import divide, run_jobs, slurm_parameters
        from crptpro.modules import usable_device
        from crptpro.plugins import loaded_plugins
        from crptpro.values import as_path

        root = as_path(self.out, "out")
        if self.attempts < 1:
            raise CRPTproError(f"--attempts must be at least 1, got {self.attempts}.")
        self._refuse_options_of_others()
        slurm = slurm_parameters(
            partition=self.partition,
            hours=self.hours,
            memory_gb=self.memory_gb,
            sbatch=self.sbatch,
            has_gpu=self.device.startswith("cuda"),
        )
        if self.launcher in ("local", "inline"):
            usable_device(self.device)
        resources = divide(
            self.launcher,
            device=self.device,
            jobs=self.jobs,
            cores=self.cores_per_job,
            jobs_per_gpu=self.jobs_per_gpu,
        )
        request = self._request(resources)
        wanted = self._wanted(request)
        plan = make_plan([cell.job for cells in wanted.values() for cell in cells], root)
        sizes = [bytes_of(job) for job in plan.missing]
        working = sorted((during for _, during in sizes), reverse=True)[: resources.jobs]
        disk = sum(after for after, _ in sizes) + sum(working)
        print(f"{', '.join(wanted)} at scale {self.scale} in {root}\n")
        print(plan_text(plan, root, disk, resources.jobs), flush=True)
        evaluations = len(request.encoder_seeds) * len(request.downstream_seeds)
        if any(job.kind == "run" for job in plan.jobs) and evaluations < PAPER_RUNS:
            print(
                f"\nRuns behind each score: {evaluations}; the paper has {PAPER_RUNS} (--seeds, --encoder-seeds)."
            )
        if idle := self._without_effect(request, [cell for cells in wanted.values() for cell in cells]):
            print(f"\nWithout effect on {', '.join(wanted)}: {', '.join(idle)}.", flush=True)
        if self.dry_run:
            return
        require_disk(root, disk, "What this plan has yet to make")
        # What a launcher lacks is said before anything is written.
        launcher = self._launcher(resources, slurm) if plan.missing else None
        asked = {**dataclasses.asdict(request), "scale": self.scale}
        for name, cells in wanted.items():
            rows = [(cell.label, cell.job.key, cell.place) for cell in cells]
            write_cells(root, name, self.scale, asked, rows)
        if launcher is not None:
            failures: list[Failure] = []
            try:
                run_jobs(
                    plan, root, launcher, jobs=resources.jobs, cores=resources.cores, device=self.device,
                    plugins=loaded_plugins(), attempts=self.attempts, failures=failures,
                )  # fmt: skip
            finally:
                launcher.close()
                if failures:  # also where Ctrl-C or an error ended it
                    print(failures_text(failures), flush=True)
            if failures:
                raise SystemExit(1)
        print(f"\nAll of it is there. Tables and figures: crptpro report {root}", flush=True)

    def _refuse_options_of_others(self) -> None:
        """An option that the launcher does not read was meant for another one."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        for name, launchers in _READ_BY.items():
            if getattr(self, name) != usual[name] and self.launcher not in launchers:
                raise CRPTproError(
                    f"--{name.replace('_', '-')} is for --launcher {' or '.join(launchers)}; "
                    f"--launcher {self.launcher} does not read it."
                )
        if self.launcher == "inline" and (self.jobs or 1) > 1:
            raise CRPTproError(f"--launcher inline runs one job at a time, not --jobs {self.jobs}.")
        if self.jobs_per_gpu != 1 and not self.device.startswith("cuda"):
            raise CRPTproError(f"--jobs-per-gpu is for --device cuda, not {self.device}.")
        if self.launcher in ("slurm", "ray") and self.device.startswith("cuda:"):
            raise CRPTproError(
                f"--launcher {self.launcher} gives each job a GPU of its own: write --device cuda, not {self.device}."
            )

    def _request(self, resources: Resources) -> Request:
        from crptpro.experiments.matrix import SCALES, Request

        is_here = self.launcher in ("local", "inline")
        return Request(
            SCALES[self.scale],
            methods=self.methods,
            groups=self.groups,
            tasks=self.tasks,
            encoder_seeds=self.encoder_seeds,
            seeds=self.seeds,
            colors="reversed_image" if self.colors_by == "image" else "reversed_background",
            device=self.device,
            threads=resources.cores * (resources.jobs if is_here else 1),
        )

    def _wanted(self, request: Request) -> dict[str, list[Cell]]:
        """Cells by experiment. One that was named must have some; of all, those that have are meant."""
        from crptpro.experiments.matrix import EXPERIMENTS

        wanted = {name: EXPERIMENTS[name].cells(request) for name in _names(self.experiments)}
        empty = [name for name, cells in wanted.items() if not cells]
        if empty:
            nothing = f"Nothing of {', '.join(empty)} is among these groups, tasks and methods"
            if ALL not in self.experiments or {*empty} & {*self.experiments} or len(empty) == len(wanted):
                raise CRPTproError(f"{nothing}; leave out --groups, --tasks or --methods.")
            print(f"{nothing}.\n")
        return {name: cells for name, cells in wanted.items() if cells}

    def _without_effect(self, request: Request, cells: Sequence[Cell]) -> list[str]:
        """Name methods, groups and tasks that no cell has, and seeds and colours that none reads."""
        places = [(cell.label, cell.job.facts.get("domains", ()), cell.place) for cell in cells]
        said = []
        for name in ("methods", "groups", "tasks"):
            for value in getattr(request, name):
                if not any(_mentions(name, value, *place) for place in places):
                    said.append(f"--{name} {value}")
        if self.seeds and not any("seed" in cell.place for cell in cells):
            said.append(f"--seeds {' '.join(map(str, self.seeds))}")
        if self.colors_by == "image" and all(
            cell.place.get("colors", "normal") == "normal" for cell in cells
        ):
            said.append("--colors-by image")
        return said

    def _launcher(self, resources: Resources, slurm: dict[str, Any]) -> Launcher:
        from crptpro.experiments.launch import InlineLauncher, LocalLauncher, RayLauncher, SlurmLauncher

        if self.launcher == "ray":
            gpus = 1 / self.jobs_per_gpu if self.device.startswith("cuda") else 0
            return RayLauncher(self.ray_address, cores=resources.cores, gpus=gpus)
        if self.launcher == "slurm":
            return SlurmLauncher(slurm)
        return InlineLauncher() if self.launcher == "inline" else LocalLauncher(resources.gpus)


def _mentions(name: str, value: str, label: str, domains: Sequence[str], place: Mapping[str, Any]) -> bool:
    from crptpro.domains import get_domain

    if name == "methods":
        return value == label.split(",")[0].split(" ")[0]
    if name == "tasks" and get_domain(value).name in (*domains, place.get("domain")):
        return True
    return value in place.values()


def plan_text(plan: Plan, root: Path, disk: int, jobs: int) -> str:
    """Return how many jobs of each kind are needed, done and to do, with their env steps, and what they take.

    Args:
        plan: of the experiments.
        root: where finished jobs are found, whose time is quoted.
        disk: bytes that must be free.
        jobs: at a time.
    """
    from crptpro.artifact import read_json
    from crptpro.experiments.jobs import DONE, JOBS, KINDS
    from crptpro.experiments.launch import duration

    spent: dict[str, list[float]] = {}
    for path in root.glob(f"{JOBS}/*/{DONE}"):
        spent.setdefault(path.parent.name.split("-")[0], []).append(float(read_json(path)["seconds"]))
    missing = {job.key for job in plan.missing}
    rows: list[tuple[str, ...]] = [("jobs", "needed", "done", "to do", "env steps", "took each")]
    for kind, name in KINDS.items():
        of_kind = [job for job in plan.jobs if job.kind == kind]
        if not of_kind:
            continue
        left = [job for job in of_kind if job.key in missing]
        env_steps = sum(_env_steps(job) for job in left)
        took = duration(statistics.median(spent[kind])) if kind in spent else ""
        numbers = (len(of_kind), len(of_kind) - len(left), len(left))
        rows.append((name, *(f"{n:,}" for n in numbers), f"{env_steps:,}" if env_steps else "", took))
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:]))]
        ).rstrip()
        for row in rows
    ]
    lines.insert(1, "-" * len(lines[0]))
    if plan.missing:
        lines += ["", f"{jobs} at a time; the disk needs {max(disk, 10**6) / 1e9:,.2f} GB."]
        if spent:
            lines.append("The last column is the median of what finished jobs in this directory took.")
    return "\n".join(lines)


def _env_steps(job: Job) -> int:
    from crptpro.envs import resolve_action_repeat

    if job.kind == "dataset":
        return job.facts["transitions"] * resolve_action_repeat(job.facts["domain"], None)
    return job.facts["env_steps"] if job.kind in ("explored", "run") else 0


def failures_text(failures: Sequence[Failure]) -> str:
    """List what is not finished, and where to look."""
    failed = [failure for failure in failures if failure.log is not None]
    skipped = [failure for failure in failures if failure.log is None]
    lines = [f"{len(failed)} failed:"]
    for failure in failed:
        times = "once" if failure.attempts == 1 else f"{failure.attempts} times"
        lines += [f"  {failure.key} (tried {times})", f"    {failure.reason}", f"    log: {failure.log}"]
    if skipped:
        lines.append(f"{len(skipped)} not started, because they need one that failed:")
        lines += [f"  {failure.key}" for failure in skipped]
    lines.append("The same command tries them again; everything else is kept.")
    return "\n".join(lines)


def _names(experiments: Sequence[str]) -> list[str]:
    """Check names, put every experiment for `all`, and drop repeats."""
    from crptpro.experiments.matrix import EXPERIMENTS

    if not experiments:
        raise UnknownNameError(f"Name an experiment: {', '.join(EXPERIMENTS)}, or {ALL}.")
    for name in experiments:
        if name not in (*EXPERIMENTS, ALL):
            near = difflib.get_close_matches(name, EXPERIMENTS, n=1, cutoff=0.5)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise UnknownNameError(
                f"There is no experiment {name!r}.{hint} There are {', '.join(EXPERIMENTS)}."
            )
    return list(EXPERIMENTS) if ALL in experiments else list(dict.fromkeys(experiments))

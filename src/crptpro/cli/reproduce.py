"""``crptpro reproduce``: experiments of the paper, also at scales of small machines."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from tyro.conf import Positional, arg

from crptpro.artifact import read_json, require_disk
from crptpro.domains import get_domain
from crptpro.envs import resolve_action_repeat
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.experiments import launch
from crptpro.experiments.jobs import DONE, JOBS, KINDS, Plan, bytes_of, make_plan, write_cells
from crptpro.experiments.matrix import EXPERIMENTS, SCALES, Cell, Request
from crptpro.free_memory import free_bytes
from crptpro.modules import PixelEncoder, resolve_precision, usable_device
from crptpro.provenance import cpu_cores
from crptpro.values import as_path

ALL = "all"
_EXPERIMENTS_DEFAULT = arg(help_behavior_hint="(default: the experiment's)")
_LAUNCHERS = {
    "partition": ("slurm",), "hours": ("slurm",), "memory_gb": ("slurm",), "sbatch": ("slurm",),
    "ray_address": ("ray",), "jobs_per_gpu": ("local", "ray"),
}  # fmt: skip
"""Options that only some launchers read."""
PAPER_RUNS = 6
"""Least number of evaluations behind the paper's scores of CRPTpro; for other methods it states none."""


@dataclass(frozen=True)
class Reproduce:
    """Reproduce an experiment of the paper: print the plan, then run whatever job is missing.

    Experiments: seen, unseen, colors, finetune, efficiency, ablation, sensitivity, prototypes, coverage, stability,
    visualize, probe, or all. Finished jobs are reused, also those of other experiments; after an interruption the same
    command resumes. `crptpro report ROOT` then makes tables and figures. The default of at most three runs on one
    encoder is below the paper's six or more evaluations: --encoder-seeds 0 1 gives six.
    """

    experiments: Annotated[
        Positional[tuple[str, ...]], arg(metavar="EXPERIMENT [EXPERIMENT ...]", help_behavior_hint="(required)")
    ]
    """one or several experiments, e.g. `seen`, or `all`"""
    scale: Literal["tiny", "small", "paper"]
    """tiny shows in minutes that everything runs; small fits two CPU cores; paper has the paper's numbers"""
    methods: Annotated[tuple[str, ...], _EXPERIMENTS_DEFAULT] = ()
    """only these methods, e.g. `crptpro drq random-encoder`"""
    groups: Annotated[tuple[str, ...], _EXPERIMENTS_DEFAULT] = ()
    """only these pre-training groups, of A B C D"""
    tasks: Annotated[tuple[str, ...], _EXPERIMENTS_DEFAULT] = ()
    """only these tasks, e.g. `walker_run`"""
    seeds: Annotated[tuple[int, ...], arg(help_behavior_hint="(default: as many as the scale has, from 0)")] = ()
    """seeds of the downstream runs on each encoder"""
    encoder_seeds: tuple[int, ...] = (0,)
    """seeds of data and pre-training"""
    out: Annotated[str, arg(metavar="PATH")] = "runs/reproduce"
    """ROOT, the directory of all jobs and results; finished jobs in it are reused"""
    dry_run: bool = False
    """print the plan and run nothing"""
    device: str = "cpu"
    """device of the networks: cpu, cuda (jobs share this machine's GPUs, or get one of the cluster's), or cuda:1"""
    launcher: Literal["local", "slurm", "ray"] = "local"
    """local: processes here; slurm, ray: a cluster whose nodes share ROOT"""
    jobs: int | None = None
    """most jobs at a time, each with its own memory (None: one per core; with GPUs --jobs-per-gpu each; cluster 16)"""
    cores_per_job: int | None = None
    """cores of each job (None: this machine's divided by jobs; on a cluster 1, or 4 with a GPU)"""
    jobs_per_gpu: int = 1
    """local, ray: how many jobs share a GPU"""
    partition: str | None = None
    """slurm: partition (None: the cluster's)"""
    hours: float = 24.0
    """slurm: time limit of a job; one that reaches it is requeued and resumes"""
    memory_gb: float = 16.0
    """slurm: memory of a job"""
    sbatch: Annotated[tuple[str, ...], arg(help_behavior_hint="(default: none)")] = ()
    """slurm: further options as `key=value`, e.g. `account=robots qos=high`"""
    ray_address: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """ray: head of the cluster (None: RAY_ADDRESS, or one on this machine)"""

    def run(self) -> None:
        root = as_path(self.out, "out")
        slurm = self._checked_options()
        jobs, cores, gpus = launch.divide(
            self.launcher, device=self.device, jobs=self.jobs, cores=self.cores_per_job, jobs_per_gpu=self.jobs_per_gpu
        )
        request = Request(
            SCALES[self.scale], methods=self.methods, groups=self.groups, tasks=self.tasks, seeds=self.seeds,
            encoder_seeds=self.encoder_seeds, device=self.device,
            threads=min(cores * jobs, cpu_cores()) if self.launcher == "local" else cores,
        )  # fmt: skip
        wanted = self._wanted(request)
        plan = make_plan([cell.job for cells in wanted.values() for cell in cells], root)
        sizes = [bytes_of(job) for job in plan.missing]
        working = sorted((during for _, during in sizes), reverse=True)[:jobs]
        disk = sum(after for after, _ in sizes) + sum(working)
        print(f"{', '.join(wanted)} at scale {self.scale} in {root}\n")
        print(plan_text(plan, root, disk, jobs), flush=True)
        # At most this many runs, which keep dense maps, share the memory.
        sharing = min(jobs, max(1, sum(job.kind == "run" for job in plan.missing)))
        if self.launcher == "local" and self.device == "cpu" and (hint := memory_text(plan, sharing)):
            print(hint, flush=True)
        runs = len(request.encoder_seeds) * len(request.seeds)
        if any(job.kind == "run" for job in plan.jobs) and runs < PAPER_RUNS:
            paper = f"the paper has at least {PAPER_RUNS} for CRPTpro (--seeds, --encoder-seeds)"
            print(f"\nRuns behind each score: {runs}; {paper}.")
        for name in () if ALL in self.experiments else wanted:
            if names := left_out(request, wanted[name]):
                print(f"\nNot part of {name}, and left out: {', '.join(names)}.")
        if self.dry_run:
            return
        require_disk(root, disk, "The rest of this plan")
        # Created before anything is written, because it may fail.
        launcher = self._launcher(slurm, gpus, sharing) if plan.missing else None
        for name, cells in wanted.items():
            write_cells(root, name, self.scale, [(cell.label, cell.job.key, cell.place) for cell in cells])
        if launcher is not None:
            failures = launch.run_jobs(plan, root, launcher, jobs=jobs, cores=cores, device=self.device)
            if failures:
                print(failures_text(failures), flush=True)
                raise SystemExit(1)
        print(f"\nEverything requested is finished. Tables and figures: crptpro report {root}", flush=True)

    def _checked_options(self) -> dict[str, Any]:
        """Refuse impossible options, and those of another launcher; returns the parameters of Slurm."""
        for each in dataclasses.fields(self):
            launchers = _LAUNCHERS.get(each.name, (self.launcher,))
            if getattr(self, each.name) != each.default and self.launcher not in launchers:
                raise CRPTproError(
                    f"--{each.name.replace('_', '-')} is for --launcher {' or '.join(launchers)}; "
                    f"--launcher {self.launcher} does not read it."
                )
        if self.jobs_per_gpu != 1 and not self.device.startswith("cuda"):
            raise CRPTproError(f"--jobs-per-gpu is for --device cuda, not {self.device}.")
        if self.launcher == "local":
            usable_device(self.device)
        elif self.device.startswith("cuda:"):
            raise CRPTproError(
                f"--launcher {self.launcher} gives each job a GPU of its own: write --device cuda, not {self.device}."
            )
        return launch.slurm_parameters(
            partition=self.partition, hours=self.hours, memory_gb=self.memory_gb, sbatch=self.sbatch,
            has_gpu=self.device.startswith("cuda"),
        )  # fmt: skip

    def _wanted(self, request: Request) -> dict[str, list[Cell]]:
        """Return cells by experiment. A named experiment must have cells; ``all`` means those that have any."""
        if not self.experiments:
            raise CRPTproError(f"Name at least one experiment: {', '.join(EXPERIMENTS)}, or {ALL}.")
        for name in self.experiments:
            if name not in (*EXPERIMENTS, ALL):
                raise UnknownNameError(
                    f"There is no experiment {name!r}; choose from {', '.join(EXPERIMENTS)}, or {ALL}."
                )
        names = EXPERIMENTS if ALL in self.experiments else dict.fromkeys(self.experiments)
        wanted = {name: EXPERIMENTS[name].cells(request) for name in names}
        empty = [name for name, cells in wanted.items() if not cells]
        if set(empty) & set(self.experiments) or len(empty) == len(wanted):
            raise CRPTproError(
                f"Nothing of {', '.join(empty)} is among these groups, tasks and methods; leave out --groups, --tasks "
                "or --methods."
            )
        return {name: cells for name, cells in wanted.items() if cells}

    def _launcher(self, slurm: dict[str, Any], gpus: Sequence[str], sharing: int) -> Any:
        if self.launcher == "slurm":
            return launch.SlurmLauncher(slurm)
        if self.launcher == "ray":
            return launch.RayLauncher(self.ray_address, gpus=self.device.startswith("cuda") / self.jobs_per_gpu)
        return launch.LocalLauncher(gpus, jobs=sharing)


def left_out(request: Request, cells: Sequence[Cell]) -> list[str]:
    """Return the requested methods, groups and tasks that are in no cell: not every experiment covers them."""
    found = {re.split("[ ,]", cell.label)[0] for cell in cells}
    for cell in cells:
        found |= {cell.place.get(name) for name in ("group", "task", "domain")}
        found |= {*str(cell.place.get("domains", "")).split("+"), *cell.job.facts.get("domains", ())}
    tasks = [task for task in request.tasks if get_domain(task).name not in found]
    return [name for name in (*request.methods, *request.groups, *tasks) if name not in found]


def plan_text(plan: Plan, root: Path, disk: int, jobs: int) -> str:
    """Return a table of needed, finished and missing jobs by kind, with their env steps and times."""
    import pandas as pd

    done = list(root.glob(f"{JOBS}/*/{DONE}"))
    kinds = [path.parent.name.split("-")[0] for path in done]
    spent = (
        pd.Series([read_json(path, keys=("seconds",))["seconds"] for path in done], kinds, float)
        .groupby(level=0)
        .median()
    )
    rows = []
    for kind, name in KINDS.items():
        needed = sum(job.kind == kind for job in plan.jobs)
        missing = [job for job in plan.missing if job.kind == kind]
        if needed:
            env_steps = sum(job.facts.get("env_steps", 0) for job in missing)
            counts = {"needed": needed, "done": needed - len(missing), "to do": len(missing), "env steps": env_steps}
            took = launch.duration(spent[kind]) if kind in spent else ""
            rows.append({"jobs": name, **{what: f"{n:,}" for what, n in counts.items()}, "took each": took})
    text = pd.DataFrame(rows).to_string(index=False)
    if plan.missing:
        text += f"\n\n{jobs} at a time; the disk needs {max(disk, 10**6) / 1e9:,.2f} GB."
        if done:
            text += "\nThe last column is the median of what finished jobs in this directory took."
    return text


def memory_text(plan: Plan, jobs: int) -> str:
    """Return a hint that fewer jobs at a time may be faster, as their runs could keep dense maps; empty if all can."""
    from crptpro.training.downstream import most_observations  # late, as they import TorchRL
    from crptpro.transforms.dense_shift import dense_maps_bytes

    methods: dict[int, list[str]] = {}  # by the size of their dense maps
    for facts in (job.facts for job in plan.missing if job.kind == "run" and job.needs):  # without DrQ's
        stored = most_observations(facts["task"], facts["env_steps"], resolve_action_repeat(facts["task"]))
        slots = min(facts["replay_capacity"] * 51 // 50, stored)
        needed = dense_maps_bytes(PixelEncoder(), slots, resolve_precision("auto", "cpu"), latent_dim=128)
        methods.setdefault(needed, []).append(facts["method"])
    usable = 0.8 * free_bytes(torch.device("cpu"))  # by dense maps
    too_large = [
        f"{needed / 1e9:.1f} GB for {', '.join(dict.fromkeys(names))} "
        + (
            f"(they fit with --jobs {int(usable / needed)})"
            if usable >= needed
            else "(more than this machine has free)"
        )
        for needed, names in sorted(methods.items())
        if needed > usable / jobs
    ]
    if not too_large:
        return ""
    return (
        f"Each job can use {usable / jobs / 1e9:.1f} GB of memory for dense maps. Runs whose maps do not fit encode "
        f"again at every update, which is several times slower. The maps take {'; '.join(too_large)}."
    )


def failures_text(failures: Sequence[launch.Failure]) -> str:
    """Return the list of unfinished jobs with their logs."""
    skipped = [f"  {failure.key}" for failure in failures if failure.log is None]
    lines = [f"{len(failures) - len(skipped)} failed:"]
    for failure in failures:
        if failure.log is not None:
            times = "once" if failure.attempts == 1 else f"{failure.attempts} times"
            lines += [f"  {failure.key} (tried {times})", f"    {failure.reason}", f"    log: {failure.log}"]
    if skipped:
        lines += [f"{len(skipped)} not started, because they need one that failed:", *skipped]
    lines.append("The same command tries them again; everything else is kept.")
    return "\n".join(lines)

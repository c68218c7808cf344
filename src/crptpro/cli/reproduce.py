"""``crptpro reproduce``: an experiment of the paper, at a scale that can be afforded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from crptpro.experiments.goals import Goal, Request
    from crptpro.experiments.launching import Failure, Launcher, Resources, SlurmRequest

ALL = "all"
_ITS_OWN = arg(help_behavior_hint="(default: the experiment's)")


@dataclass(frozen=True)
class Reproduce:
    """Make an experiment of the paper again: print the plan, then make whatever is missing.

    Experiments: seen, unseen, colors, finetune, efficiency, ablation, sensitivity, prototypes, coverage, stability,
    visualize, probe, study, or all. Whatever is finished, by this or another experiment, is used again; interrupted,
    the same command continues. At the end `crptpro report ROOT` makes tables and figures of it.
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
    out: Path = Path("runs/reproduce")
    """ROOT, where everything is kept and found again"""
    dry_run: bool = False
    """print the plan and make nothing"""
    device: str = "cpu"
    """of networks: cpu, cuda (jobs share this machine's GPUs, or have one of the cluster's), or cuda:1"""
    launcher: Literal["local", "slurm", "ray", "inline"] = "local"
    """local: processes here; slurm, ray: a cluster whose nodes share ROOT; inline: in this process, one at a time"""
    jobs: int | None = None
    """most pieces at a time, each with its own memory (default: one per core, or as many as the GPUs take by
    --jobs-per-gpu, which is also the most here; on a cluster 16)"""
    cores_per_job: int | None = None
    """cores of each job (default: this machine's divided by jobs; on a cluster 1, beside a GPU 4)"""
    jobs_per_gpu: int = 1
    """local, ray: how many jobs share a GPU"""
    attempts: int = 3
    """jobs that may try a piece before it counts as failed; each continues where the one before was lost"""
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
        """Print the plan, make what is missing, list what failed."""
        from crptpro.cards import require_disk
        from crptpro.errors import CRPTproError
        from crptpro.experiments.costs import estimate
        from crptpro.experiments.launching import SlurmRequest, divide, run_pieces
        from crptpro.experiments.pace import network_pace
        from crptpro.experiments.plan import make_plan
        from crptpro.experiments.plan_text import failures_text, plan_text
        from crptpro.experiments.requests import write_request
        from crptpro.experiments.store import Store
        from crptpro.experiments.unread import unread
        from crptpro.modules import usable_device
        from crptpro.plugins import loaded_plugins

        if self.attempts < 1:
            raise CRPTproError(f"--attempts must be at least 1, got {self.attempts}.")
        self._refuse_options_of_others()
        slurm = SlurmRequest(self.partition, self.hours, self.memory_gb, self.sbatch)
        if self.launcher in ("local", "inline"):
            usable_device(self.device)
        resources = divide(
            self.launcher,
            device=self.device,
            jobs=self.jobs,
            cores_per_job=self.cores_per_job,
            jobs_per_gpu=self.jobs_per_gpu,
        )
        request = self._request(resources)
        wanted = self._wanted(request)
        store = Store(self.out)
        plan = make_plan([goal.piece for goals in wanted.values() for goal in goals], store)
        threads = resources.job_settings(self.device).threads
        is_here = self.launcher in ("local", "inline") and self.device == "cpu"
        cost = estimate(
            plan,
            store,
            jobs=resources.jobs,
            device=self.device,
            threads=threads,
            time_networks=network_pace if is_here else None,
        )
        print(f"{', '.join(wanted)} at scale {self.scale} in {self.out}\n")
        print(plan_text(plan, cost, jobs=resources.jobs, device=self.device), flush=True)
        if idle := unread(request, lambda other: _goals(wanted, other)):
            print(f"\nWithout effect on {', '.join(wanted)}: {', '.join(idle)}.", flush=True)
        if self.dry_run:
            return
        require_disk(self.out, cost.disk_bytes, "What this plan has yet to make")
        # What a launcher lacks is said before anything is written.
        launcher = self._launcher(resources, slurm) if plan.missing else None
        for name, goals in wanted.items():
            write_request(store, name, request, goals)
        if launcher is not None:
            settings = resources.job_settings(self.device, loaded_plugins())
            failures: list[Failure] = []
            try:
                run_pieces(
                    plan, store, settings, launcher,
                    jobs=resources.jobs, attempts=self.attempts, failures=failures,
                )  # fmt: skip
            finally:
                launcher.close()
                if failures:  # also where Ctrl-C or an error ended it
                    print(failures_text(failures), flush=True)
            if failures:
                raise SystemExit(1)
        print(f"\nAll of it is there. Tables and figures: crptpro report {self.out}", flush=True)

    def _refuse_options_of_others(self) -> None:
        """An option that the launcher does not read was meant for another one."""
        from crptpro.errors import CRPTproError

        defaults = {field.name: field.default for field in fields(self)}
        given = {name for name, usual in defaults.items() if getattr(self, name) != usual}
        read_by = {
            "partition": ("slurm",), "hours": ("slurm",), "memory_gb": ("slurm",), "sbatch": ("slurm",),
            "ray_address": ("ray",), "jobs_per_gpu": ("local", "ray"),
        }  # fmt: skip
        for name, launchers in read_by.items():
            if name in given and self.launcher not in launchers:
                raise CRPTproError(
                    f"--{name.replace('_', '-')} is for --launcher {' or '.join(launchers)}; "
                    f"--launcher {self.launcher} does not read it."
                )
        if self.launcher == "inline" and (self.jobs or 1) > 1:
            raise CRPTproError(f"--launcher inline makes one piece at a time, not --jobs {self.jobs}.")
        if "jobs_per_gpu" in given and not self.device.startswith("cuda"):
            raise CRPTproError(f"--jobs-per-gpu is for --device cuda, not {self.device}.")
        if self.launcher in ("slurm", "ray") and self.device.startswith("cuda:"):
            raise CRPTproError(
                f"--launcher {self.launcher} gives each job a GPU of its own: write --device cuda, not {self.device}."
            )

    def _request(self, resources: Resources) -> Request:
        from crptpro.experiments.goals import Request
        from crptpro.experiments.launching import threads_alone
        from crptpro.experiments.scales import get_scale

        return Request(
            get_scale(self.scale),
            methods=self.methods,
            groups=self.groups,
            tasks=self.tasks,
            encoder_seeds=self.encoder_seeds,
            seeds=self.seeds or None,
            colors="reversed_image" if self.colors_by == "image" else "reversed_background",
            device=self.device,
            threads=threads_alone(self.launcher, resources),
        )

    def _wanted(self, request: Request) -> dict[str, list[Goal]]:
        """Goals by experiment. One that was named must have some; of all, those that have are meant."""
        from crptpro.errors import CRPTproError
        from crptpro.experiments.catalogue import EXPERIMENTS

        wanted = {name: EXPERIMENTS[name].goals(request) for name in _names(self.experiments)}
        empty = [name for name, goals in wanted.items() if not goals]
        if empty and (
            ALL not in self.experiments or set(empty) & {*self.experiments} or len(empty) == len(wanted)
        ):
            raise CRPTproError(
                f"Nothing of {', '.join(empty)} is among these groups, tasks and methods; "
                "leave out --groups, --tasks or --methods."
            )
        if empty:
            print(f"Nothing of {', '.join(empty)} is among these groups, tasks and methods.\n")
        return {name: goals for name, goals in wanted.items() if goals}

    def _launcher(self, resources: Resources, slurm: SlurmRequest) -> Launcher:
        from crptpro.experiments.launching import make_launcher

        return make_launcher(
            self.launcher, resources, device=self.device, slurm=slurm, ray_address=self.ray_address
        )


def _goals(names: Iterable[str], request: Request) -> list[Goal]:
    from crptpro.experiments.catalogue import EXPERIMENTS

    return [goal for name in names for goal in EXPERIMENTS[name].goals(request)]


def _names(experiments: Sequence[str]) -> list[str]:
    """Check names, put every experiment for `all`, and drop repeats."""
    from crptpro.errors import UnknownNameError
    from crptpro.experiments.catalogue import EXPERIMENTS, get_experiment

    if not experiments:
        raise UnknownNameError(f"Name an experiment: {', '.join(EXPERIMENTS)}, or {ALL}.")
    names = [get_experiment(name).name for name in experiments if name != ALL]
    return list(EXPERIMENTS) if ALL in experiments else list(dict.fromkeys(names))

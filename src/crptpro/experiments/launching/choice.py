"""Which launcher, and how it divides cores and GPUs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from crptpro.cards import cpu_cores
from crptpro.errors import CRPTproError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching.gpus import visible_gpus
from crptpro.experiments.launching.launchers import InlineLauncher, Launcher

LauncherName = Literal["local", "slurm", "ray", "inline"]

CLUSTER_JOBS = 16
CLUSTER_GPU_CORES = 4
"""Cores of a job that has a cluster's GPU: the simulator draws and evaluates on them."""


@dataclass(frozen=True)
class Resources:
    """What jobs have, together and each.

    Args:
        jobs: at a time.
        cores_per_job: for each.
        gpus: of this machine, that local jobs share; empty if they have none, or the one that ``device`` names.
        jobs_per_gpu: jobs that share one.
    """

    jobs: int
    cores_per_job: int
    gpus: tuple[str, ...] = ()
    jobs_per_gpu: int = 1

    def job_settings(self, device: str, plugins: tuple[str, ...] = ()) -> JobSettings:
        """Return the settings of one job."""
        cores = self.cores_per_job
        return JobSettings(device=device, threads=cores, workers=cores, plugins=plugins)


def threads_alone(launcher: LauncherName, resources: Resources) -> int:
    """Threads of a piece that has its machine to itself: on one machine, those of all jobs."""
    return resources.cores_per_job * (resources.jobs if launcher in ("local", "inline") else 1)


def divide(
    launcher: LauncherName,
    *,
    device: str = "cpu",
    jobs: int | None = None,
    cores_per_job: int | None = None,
    jobs_per_gpu: int = 1,
) -> Resources:
    """Fill in what the user left open.

    On one machine there is a job per core, or, with ``device="cuda"``, per GPU times ``jobs_per_gpu``; with
    ``device="cuda:1"`` there are ``jobs_per_gpu`` on that GPU alone. The cores are divided among them. On a cluster
    there are 16 jobs, with a core each, or four beside a GPU.

    Args:
        launcher: where jobs run; ``inline`` makes one piece at a time.
        device: of networks.
        jobs: most at a time.
        cores_per_job: threads, and processes that collect.
        jobs_per_gpu: jobs that share a GPU.

    Raises:
        CRPTproError: a number below 1, no GPU where one is asked for, or more jobs than this machine's GPUs take.
    """
    for name, value in (("jobs", jobs), ("cores-per-job", cores_per_job), ("jobs-per-gpu", jobs_per_gpu)):
        if value is not None and value < 1:
            raise CRPTproError(f"--{name} must be at least 1, got {value}.")
    if launcher in ("slurm", "ray"):
        usual = CLUSTER_GPU_CORES if device.startswith("cuda") else 1
        return Resources(jobs or CLUSTER_JOBS, cores_per_job or usual, jobs_per_gpu=jobs_per_gpu)
    cores = cpu_cores()
    gpus = _require_gpus() if device == "cuda" else ()
    if launcher == "inline":
        return Resources(1, cores_per_job or cores)
    used = len(gpus) if device == "cuda" else int(device.startswith("cuda"))
    if used:
        jobs = _jobs_on_gpus(used, jobs, jobs_per_gpu)
    jobs = jobs or max(1, cores // (cores_per_job or 1))
    return Resources(jobs, cores_per_job or max(1, cores // jobs), gpus, jobs_per_gpu)


def _jobs_on_gpus(gpus: int, jobs: int | None, jobs_per_gpu: int) -> int:
    """As many as were asked for, or as the GPUs take; too many might not find memory on them."""
    room = gpus * jobs_per_gpu
    if jobs is not None and jobs > room:
        raise CRPTproError(
            f"--jobs {jobs} are more than {gpus} GPU{'s' * (gpus > 1)} take{'s' * (gpus == 1)} with --jobs-per-gpu "
            f"{jobs_per_gpu}: ask for --jobs {room}, or let more share a GPU with --jobs-per-gpu {-(-jobs // gpus)}."
        )
    return jobs or room


def _require_gpus() -> tuple[str, ...]:
    import torch

    gpus = visible_gpus()
    if not gpus or not torch.cuda.device_count():
        raise CRPTproError(
            "--device cuda: this machine has no GPU that torch can use; --device cpu always works."
        )
    return gpus


OWN_OPTIONS = {
    "cpus-per-task": "--cores-per-job",
    "time": "--hours",
    "mem": "--memory-gb",
    "partition": "--partition",
}
"""Options of sbatch that every job is given by one of ours."""


@dataclass(frozen=True)
class SlurmRequest:
    """What a Slurm job asks for besides cores and a GPU.

    Args:
        partition: the cluster's own default if ``None``.
        hours: after which Slurm ends a job; it is queued again and continues.
        memory_gb: of each job.
        sbatch: further options as ``key=value``.

    Raises:
        CRPTproError: no time, no memory, an option that is not ``key=value``, or one that has an option of its own.
    """

    partition: str | None = None
    hours: float = 24.0
    memory_gb: float = 16.0
    sbatch: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        """Refuse what Slurm would read as something else."""
        if not self.hours * 60 >= 1:
            raise CRPTproError(f"--hours must be at least a minute (0.017), got {self.hours:g}.")
        if not self.memory_gb >= 1:
            raise CRPTproError(f"--memory-gb must be at least 1, got {self.memory_gb:g}.")
        for option in self.sbatch:
            key, equals, _ = option.partition("=")
            if not key or not equals:
                raise CRPTproError(f"--sbatch {option}: write key=value, e.g. qos=high or account=robots.")
            if instead := OWN_OPTIONS.get(key.lstrip("-").replace("_", "-")):
                raise CRPTproError(f"--sbatch {option} would be overruled: say it by {instead}.")


def make_launcher(
    name: LauncherName,
    resources: Resources,
    *,
    device: str = "cpu",
    slurm: SlurmRequest | None = None,
    ray_address: str | None = None,
) -> Launcher:
    """Return a launcher that is ready to start jobs.

    Raises:
        CRPTproError: if what it needs is not installed or cannot be reached.
    """
    has_gpu = device.startswith("cuda")
    if name == "inline":
        return InlineLauncher()
    if name == "local":
        from crptpro.experiments.launching.submitted import LocalLauncher

        return LocalLauncher(resources.gpus)
    if name == "slurm":
        from crptpro.experiments.launching.slurm import SlurmLauncher

        return SlurmLauncher(slurm_parameters(slurm or SlurmRequest(), has_gpu=has_gpu))
    from crptpro.experiments.launching.ray_cluster import RayLauncher

    gpus_per_job = 1 / resources.jobs_per_gpu if has_gpu else 0
    return RayLauncher(ray_address, gpus_per_job=gpus_per_job, cores_per_job=resources.cores_per_job)


def slurm_parameters(request: SlurmRequest, *, has_gpu: bool) -> dict[str, Any]:
    """Translate a request into parameters of submitit's Slurm executor.

    Examples:
        >>> slurm_parameters(SlurmRequest("short", hours=2, memory_gb=8, sbatch=("qos=high",)), has_gpu=False)
        {'time': 120, 'mem': '8192M', 'partition': 'short', 'additional_parameters': {'qos': 'high'}}
    """
    parameters: dict[str, Any] = {
        "time": round(request.hours * 60),
        "mem": f"{round(request.memory_gb * 1024)}M",
    }
    if request.partition is not None:
        parameters["partition"] = request.partition
    if has_gpu:
        parameters["gpus_per_node"] = 1
    further = {}
    for option in request.sbatch:
        key, _, value = option.partition("=")
        further[key.lstrip("-")] = value
    if further:
        parameters["additional_parameters"] = further
    return parameters

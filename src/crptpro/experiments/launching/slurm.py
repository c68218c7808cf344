"""Jobs of a Slurm cluster, through submitit."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from dataclasses import dataclass
from typing import Any

from crptpro.errors import CRPTproError, SubmissionError
from crptpro.experiments.launching.submitted import SubmittedJob, SubmittedWork, new_folder, require_submitit
from crptpro.experiments.launching.work import THREAD_VARIABLES, Work

MAX_REQUEUES = 1_000
"""How often a Slurm job goes on after its time was up. Each time it has got further."""


@dataclass
class SlurmJob(SubmittedJob):
    """A job that Slurm has queued or runs."""

    def stop(self) -> None:
        """Have Slurm pass SIGTERM on, or take the job from the queue; asked again, cancel it."""
        with contextlib.suppress(OSError):
            if self.is_asked_to_stop:
                subprocess.call(["scancel", self.job.job_id])
            else:
                subprocess.call(["scancel", "--state=PENDING", self.job.job_id])
                subprocess.call(["scancel", "--signal=TERM", self.job.job_id])
        self.is_asked_to_stop = True


class SlurmLauncher:
    """A Slurm cluster, whose nodes share ROOT and the environment of this process.

    Args:
        parameters: of submitit's executor: ``partition``, ``time`` (minutes), ``mem``, ``gpus_per_node``, ...

    Raises:
        CRPTproError: without submitit, or where there is no Slurm.
    """

    is_one_machine = False

    def __init__(self, parameters: dict[str, Any]) -> None:
        require_submitit("slurm")
        if shutil.which("srun") is None or shutil.which("sbatch") is None:
            raise CRPTproError(
                "--launcher slurm needs sbatch and srun, which are not here: call it on a login node of the cluster, "
                "or choose --launcher local."
            )
        self.parameters = parameters

    def start(self, work: Work, *, is_exclusive: bool) -> SlurmJob:
        """Queue a job; an exclusive one asks for a node of its own.

        Raises:
            SubmissionError: if sbatch refuses it, for good or because it is busy or the queue is full.
        """
        from submitit.slurm.slurm import SlurmExecutor

        folder = new_folder(work)
        executor = SlurmExecutor(folder, max_num_timeout=MAX_REQUEUES)
        threads = str(work.settings.threads)
        parameters = {
            "job_name": work.key,
            "cpus_per_task": work.settings.threads,
            "setup": [f"export {name}={threads}" for name in THREAD_VARIABLES],
            **self.parameters,
        }
        if is_exclusive:
            parameters["exclusive"] = True
        executor.update_parameters(**parameters)
        try:
            submitted: Any = executor.submit(SubmittedWork(work))
        except Exception as reason:
            if type(reason).__name__ != "FailedJobError":
                raise
            shutil.rmtree(folder, ignore_errors=True)  # it may be refused every minute of a night
            said = (str(reason).strip().splitlines() or ["it gave no reason"])[-1]
            raise SubmissionError(
                f"sbatch refused a job: {said} Change --partition, --hours or --sbatch."
            ) from reason
        return SlurmJob(submitted, folder, work)

    def close(self) -> None:
        """Nothing is held."""

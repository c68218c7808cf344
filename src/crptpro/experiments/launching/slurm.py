"""Jobs of a Slurm cluster, through submitit."""

from __future__ import annotations

import contextlib
import math
import shutil
import subprocess
import time
from dataclasses import dataclass, field
from typing import Any

from crptpro.errors import CRPTproError, SubmissionError
from crptpro.experiments.launching.launchers import Outcome
from crptpro.experiments.launching.submitted import SubmittedJob, SubmittedWork, new_folder, require_submitit
from crptpro.experiments.launching.work import THREAD_VARIABLES, Work

MAX_REQUEUES = 1_000
"""How often a Slurm job goes on after its time was up. Each time it has got further."""


LOOK_S = 10.0
"""How often Slurm is asked about jobs of which news is due; submitit asks every ten minutes in the end."""

PREEMPTED_LOOKS = 6
"""So many times in a row a job is found preempted that Slurm does not queue again."""


@dataclass
class Looks:
    """Looks at the queue that do not wait until submitit's own is due; each tells of all jobs.

    Args:
        pause_s: least time between two.

    Attributes:
        count: how many there were.
    """

    pause_s: float = LOOK_S
    count: int = field(default=0, init=False)
    _last: float = field(default=-math.inf, init=False)

    def take(self, job: Any) -> None:
        """Ask Slurm, unless that was just done."""
        if time.monotonic() - self._last >= self.pause_s:
            job.watcher.get_state(job.job_id, mode="force")
            self._last = time.monotonic()
            self.count += 1


@dataclass
class SlurmJob(SubmittedJob):
    """A job that Slurm has queued or runs.

    Args:
        job: as submitit knows it.
        folder: that submitit keeps it in; removed when it has ended.
        work: what it does.
        looks: shared by all jobs of a launcher.
    """

    looks: Looks = field(default_factory=Looks)
    _preempted_since: int | None = field(default=None, init=False)

    def _look(self) -> Outcome | None:
        """Submitit holds that a preempted job comes back; where ``PreemptMode`` is ``CANCEL`` none does."""
        if self.is_asked_to_stop or self._is_preempted():
            self.looks.take(self.job)
        if self.job.done():
            return self._read()
        if not self._is_preempted():
            self._preempted_since = None
        elif self._preempted_since is None:
            self._preempted_since = self.looks.count
        elif self.looks.count - self._preempted_since >= PREEMPTED_LOOKS:
            return self._lost("preempted")
        return None

    def _is_preempted(self) -> bool:
        state: str = self.job.watcher.get_state(self.job.job_id, mode="cache")
        return state.upper().startswith("PREEMPTED")

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
        parameters: of submitit's executor: ``partition``, ``time`` (minutes), ``mem``, ``gpus_per_node``, ...; lines of
            ``setup`` follow those that set the numbers of cores and threads.

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
        self._looks = Looks()

    def start(self, work: Work, *, is_exclusive: bool) -> SlurmJob:
        """Queue a job; an exclusive one asks for a node of its own.

        Raises:
            SubmissionError: if sbatch refuses it, for good or because it is busy or the queue is full.
        """
        from submitit.slurm.slurm import SlurmExecutor

        folder = new_folder(work)
        executor = SlurmExecutor(folder, max_num_timeout=MAX_REQUEUES)
        threads = work.settings.threads
        parameters = {"job_name": work.key, "cpus_per_task": threads, **self.parameters}
        # Since Slurm 22.05 srun does not ask for the cores that sbatch was given, and would run the job on one.
        environment = [f"export {name}={threads}" for name in THREAD_VARIABLES]
        environment.append(f"export SRUN_CPUS_PER_TASK={parameters['cpus_per_task']}")
        parameters["setup"] = [*environment, *parameters.get("setup", ())]
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
        return SlurmJob(submitted, folder, work, self._looks)

    def close(self) -> None:
        """Nothing is held."""

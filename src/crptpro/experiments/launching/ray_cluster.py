"""Jobs on a Ray cluster whose nodes share ROOT."""

from __future__ import annotations

import logging
import os
import socket
from dataclasses import dataclass, field
from typing import Any

from crptpro.errors import CRPTproError
from crptpro.experiments.launching.launchers import Outcome
from crptpro.experiments.launching.work import THREAD_VARIABLES, Work


@dataclass
class RayJob:
    """A task of Ray's.

    Args:
        ray: the module.
        task: reference to its result.
    """

    ray: Any
    task: Any
    is_asked_to_stop: bool = field(default=False, init=False)

    def poll(self) -> Outcome | None:
        """How it ended, or ``None``."""
        ended, _ = self.ray.wait([self.task], timeout=0)
        if not ended:
            return None
        errors = self.ray.exceptions
        try:
            refusal = self.ray.get(self.task)
        except errors.RayTaskError as reason:  # it raised
            return Outcome((str(reason).strip().splitlines() or ["it failed"])[-1])
        except errors.RayError as reason:  # its worker or its node is gone, or it was stopped
            return Outcome(f"the job was lost ({type(reason).__name__})")
        return Outcome(refusal, is_final=bool(refusal))

    def stop(self) -> None:
        """Interrupt it as Ctrl-C would, which the stages answer with a checkpoint; asked again, end its worker."""
        self.ray.cancel(self.task, force=self.is_asked_to_stop)
        self.is_asked_to_stop = True


class RayLauncher:
    """A Ray cluster; without one, Ray on this machine.

    A node that dies takes its jobs with it. They are started again on others, where their pieces continue from the
    checkpoints on the disk that the nodes share.

    Args:
        address: of the cluster's head; ``None`` for ``RAY_ADDRESS``, a cluster that runs on this machine, or a new one;
            ``"local"`` for a new one in any case.
        gpus_per_job: a whole number or a fraction of one.

    Raises:
        CRPTproError: without Ray, or if the cluster cannot be reached.
    """

    is_one_machine = False

    def __init__(self, address: str | None = None, *, gpus_per_job: float = 0) -> None:
        try:
            import ray
        except ImportError as reason:
            raise CRPTproError(
                f"--launcher ray needs Ray ({reason}): pip install 'crptpro[ray]', or choose --launcher local."
            ) from None
        self._ray: Any = ray
        self._gpus_per_job = gpus_per_job
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        address = address or os.environ.get("RAY_ADDRESS") or None
        try:
            _require_answer(address)
            try:
                ray.init(address=address or "auto", **options)
            except ConnectionError:
                if address is not None:
                    raise
                ray.init(address="local", include_dashboard=False, **options)
        except (OSError, RuntimeError, ValueError) as reason:
            said = (str(reason).strip().splitlines() or [type(reason).__name__])[0]
            raise CRPTproError(
                f"The Ray cluster {address or 'of this machine'} cannot be used: {said}. Give the address that "
                "`ray start --head` printed, as --ray-address HOST:6379, or ray://HOST:10001."
            ) from reason
        # A worker ends with its job, as a process of its own would: nothing of a job is left for the next.
        self._make = ray.remote(max_retries=0, max_calls=1)(_run)

    def start(self, work: Work, *, is_exclusive: bool) -> RayJob:
        """Queue a job; Ray starts it where cores and GPUs are free."""
        threads = work.settings.threads
        task = self._make.options(
            name=work.key,
            num_cpus=threads,
            num_gpus=self._gpus_per_job,
            runtime_env={"env_vars": dict.fromkeys(THREAD_VARIABLES, str(threads))},
        ).remote(work)
        return RayJob(self._ray, task)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def _require_answer(address: str | None) -> None:
    """Fail at once where nobody listens; Ray itself would go on asking for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()


def _run(work: Work) -> str:
    return work.run_logged()

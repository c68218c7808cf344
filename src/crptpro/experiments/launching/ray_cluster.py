"""Jobs on a Ray cluster whose nodes share ROOT."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from crptpro.errors import CRPTproError
from crptpro.experiments.launching.launchers import Outcome
from crptpro.experiments.launching.work import THREAD_VARIABLES, Work

logger = logging.getLogger(__name__)

NODE_GROUP = "ray.io/node-group"
"""Label of nodes that `ray up` or KubeRay started, which may start others as they are needed."""


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
        cores_per_job: that every job will ask for.

    Raises:
        CRPTproError: without Ray, if the cluster cannot be reached, or if none of its nodes can take a job.
    """

    is_one_machine = False

    def __init__(
        self, address: str | None = None, *, gpus_per_job: float = 0, cores_per_job: int = 1
    ) -> None:
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
        try:
            require_node(ray.nodes(), cores=cores_per_job, gpus=gpus_per_job)
        except CRPTproError:
            ray.shutdown()
            raise
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


def require_node(nodes: Sequence[Mapping[str, Any]], *, cores: int, gpus: float) -> None:
    """Make sure that some node can take a job; Ray would let it wait for ever without a word.

    Args:
        nodes: as ``ray.nodes()`` lists them.
        cores: of the job.
        gpus: of the job, a whole number or a fraction of one.

    Raises:
        CRPTproError: if none can, unless the cluster may start others: then there is a warning.
    """
    alive = [node for node in nodes if node["Alive"]]
    sizes = [(node["Resources"].get("CPU", 0), node["Resources"].get("GPU", 0)) for node in alive]
    if any(has_cores >= cores and has_gpus >= gpus for has_cores, has_gpus in sizes):
        return
    largest = max(sizes, key=lambda size: (size[1] >= gpus, *size), default=(0, 0))
    lack = (
        f"A job asks for {_size(cores, gpus)}, and no node of the Ray cluster has as much; the largest has "
        f"{_size(*largest)}."
    )
    remedy = "--cores-per-job, or --device cpu" if gpus else "--cores-per-job"
    if any(node.get("Labels", {}).get(NODE_GROUP) for node in alive):
        logger.warning("%s Jobs wait until it starts one that has; if it cannot, change %s.", lack, remedy)
        return
    raise CRPTproError(f"{lack} Change {remedy}, or add such a node.")


def _size(cores: float, gpus: float) -> str:
    return f"{cores:g} core{'s' * (cores != 1)} and {f'{gpus:g}' if gpus else 'no'} GPU{'s' * (gpus > 1)}"


def _require_answer(address: str | None) -> None:
    """Fail at once where nobody listens; Ray itself would go on asking for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()


def _run(work: Work) -> str:
    return work.run_logged()

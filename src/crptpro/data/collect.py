"""Decoupled random collection: a uniform random policy fills one dataset per domain, before any learning."""

from __future__ import annotations

import functools
import logging
import pickle
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.modules import RandomPolicy

from crptpro.artifact import require_disk
from crptpro.data.dataset import FrameDataset
from crptpro.directory_lock import refusal_leaves_nothing
from crptpro.domains import Domain, expand_groups, get_domain
from crptpro.envs import episode_length, make_env, needs_gl, resolve_action_repeat
from crptpro.envs.base import passed_on
from crptpro.envs.rendering import backend_card, select_backend
from crptpro.errors import CRPTproError, DatasetError, RenderingError, WorkerLostError
from crptpro.progress import Progress
from crptpro.seeding import derive_seed, kept_global_rng
from crptpro.values import MAX_SEED, Colors, Quality, as_int, as_path, check_choices
from crptpro.workers import SPAWN, Inline, WorkerPool, can_be_sent

logger = logging.getLogger(__name__)

STALL_S = 300.0  # workers count as hung after this long without a step of any
_AGAIN = "What was collected is kept: run the same command again"


def collect_random(domain: str | Domain, root: str | Path, **options: Any) -> Path:
    """Collect one domain's dataset as :func:`collect_group` does; returns its directory, ``root/<domain name>``."""
    return next(iter(collect_group([domain], root, **options).values()))


def collect_group(
    domains: Iterable[str | Domain],
    root: str | Path,
    *,
    transitions: int = 100_000,
    seed: int = 0,
    workers: int = 1,
    quality: Quality = "exact",
    colors: Colors = "normal",
    image_size: int = 84,
    action_repeat: int | None = None,
    progress: bool = True,
) -> dict[str, Path]:
    """Collect the datasets of several domains with a uniform random policy, or continue interrupted collections.

    The paper (section "Decoupled random collection") takes b = 100,000 transitions per domain. The same ``seed`` gives
    the same actions and, on one machine and backend, the same pixels, for any number of workers and interruptions. The
    last episode is cut to fit, and an endless one after 1000 transitions.

    Several workers are spawned processes, so a script needs the usual ``if __name__ == "__main__":``. A domain whose
    ``make`` no other process can import, e.g. one defined in a notebook, is collected in this process.

    An episode is a rollout of ``RandomPolicy``, not a batch of a TorchRL ``Collector``, which resets before the next
    episode's seeds are known; adapted to this, it took 8 % more CPU time with walker (84 x 84, software GL).

    Args:
        domains: domain names, task names, letters of the paper's groups, ``gymnasium:<id>``, or
            :class:`~crptpro.domains.Domain` objects.
        root: parent of the directories ``root/<domain name>``, one per domain.
        transitions: transitions per domain (agent steps; 21 KB each at 84 x 84).
        seed: seeds every episode, together with its domain and index.
        workers: processes, each rendering on one core; 1 is this process.
        quality: as in :func:`crptpro.envs.make_env`.
        colors: likewise; the episodes are the same in all colours.
        image_size: H = W, pixels.
        action_repeat: env steps per agent step; the domain's (2; 1 for your own) if ``None``.
        progress: show a progress line per domain (log lines where the output is not a terminal).

    Returns:
        The directory of each domain's dataset, by name.

    Raises:
        DatasetError: a directory holds something other than the requested dataset.
        DiskSpaceError: the disk cannot hold it; no frame is written, and a smaller request may use the same directory.
        UnknownNameError: an unknown domain.
        ValueError: an impossible number or path.
        WorkerLostError: a process died; finished episodes are kept.
        EnvCrashedError: the code of an environment raised an exception; likewise.
        CRPTproError: an environment returned something unusable, or hangs; likewise.
    """
    transitions = as_int(transitions, "transitions", minimum=1)
    workers, seed = as_int(workers, "workers", minimum=1), as_int(seed, "seed", minimum=0, maximum=MAX_SEED)
    root, image_size = as_path(root, "root"), as_int(image_size, "image_size", minimum=1)
    check_choices(quality=quality, colors=colors)
    paths: dict[str, Path] = {}
    jobs: list[_Job] = []
    with ExitStack() as stack:
        stack.enter_context(refusal_leaves_nothing(root))
        for domain in map(get_domain, expand_groups(domains)):
            path = dataset_path(root, domain.name)
            if path in paths.values():
                raise DatasetError(f"Two of the domains would be collected into {path}; collect them apart.")
            paths[domain.name] = path
            repeat = resolve_action_repeat(domain, action_repeat)
            sizes = {"image_size": image_size, "action_repeat": repeat}
            settings: dict[str, Any] = {**sizes, "quality": quality, "colors": colors}
            about = {"task": domain.task, "seed": seed, "camera": domain.camera, **settings}
            stack.enter_context(refusal_leaves_nothing(path))
            dataset = FrameDataset.create(path, domain=domain.name, transitions=transitions, **about)
            if dataset.is_complete:
                logger.info("%s: %s is complete", domain.name, path)
                continue
            stack.callback(dataset.writer.close)
            make = functools.partial(make_env, domain, seed=0, frame_stack=1, physics_state=True, **settings)
            jobs.append(_Job(domain, dataset, dataset.writer, make, episode_length(domain, action_repeat=repeat)))
        if jobs:
            _announce(jobs, root, image_size)
            if any(needs_gl(job.domain) for job in jobs):
                # Checked once, for as many renderers as will run: some drivers hang when several start together.
                select_backend(processes=workers)
            for job in jobs[1:]:  # an environment that cannot be built is refused before hours of collecting
                job.make(render=False).close()
            for job in jobs:
                job.writer.note_rendering(backend_card() if needs_gl(job.domain) else {})
                _collect(job, seed, workers, progress)
    return paths


def dataset_path(root: str | Path, domain_name: str) -> Path:
    """Return the directory of a domain's dataset or replay: its name, ``-`` for what a file system may refuse."""
    return Path(root) / re.sub(r"[^\w.+-]+", "-", domain_name)


def collect_episode(
    env: EnvBase, *, env_seed: int, action_seed: int, limit: int, callback: Callable[..., Any] | None = None
) -> TensorDictBase:
    """Roll out one episode of single frames with a uniform random policy; its two seeds determine it.

    The policy draws from torch's global generator. ``limit`` is the number of transitions after which the episode is
    cut, ``callback`` that of TorchRL's ``rollout``.
    """
    env.set_seed(env_seed)
    first = env.reset()
    torch.manual_seed(action_seed)
    policy = RandomPolicy(env.full_action_spec)
    return env.rollout(limit, policy, callback, auto_reset=False, tensordict=first, return_contiguous=True)


class _Job(NamedTuple):
    """A dataset to be collected."""

    domain: Domain
    dataset: FrameDataset
    writer: Any  # of the dataset
    make: Callable[..., EnvBase]
    length: int | None  # agent steps of an episode, if known


def _announce(jobs: list[_Job], root: Path, image_size: int) -> None:
    """Log how much will be written (action and state take at most 1 kB), and refuse what the disk cannot hold."""
    sizes = {}
    for job in jobs:
        missing = job.writer.missing
        frames = missing + -(-missing // (job.length or 100))  # one more per episode
        sizes[job.domain.name] = size = frames * 3 * image_size**2 + missing * 1000
        logger.info("%s: %.2g GB for %s transitions", job.dataset.path, size / 1e9, f"{missing:,}")
    require_disk(root, sum(sizes.values()), f"Collecting {', '.join(sizes)}")


def _collect(job: _Job, seed: int, workers: int, progress: bool) -> None:
    """Collect one dataset; episodes are planned, and appended, in the order of their indices."""
    name, dataset, writer, length = job.domain.name, job.dataset, job.writer, job.length
    if workers > 1 and not can_be_sent(job.make):
        workers = 1
        logger.warning(
            "%s is collected in this process: no other one can import its `make`; define it in a module.", name
        )
    bar = Progress(writer.target, writer.transitions, "transitions", label=name, is_shown=progress, lines=10)
    steps = SPAWN.RawValue("q", 0)  # of all workers
    queue: deque[tuple[str, Future[bytes]]] = deque()
    ahead = 2 * workers if workers > 1 else 1  # episodes in flight
    with ExitStack() as stack:
        if workers > 1:
            pool: Any = WorkerPool(workers, _prepare, job.make, steps)
            stack.callback(pool.end)
        else:
            pool = Inline()
            _prepare(job.make, steps)
            stack.callback(_close)
        while not dataset.is_complete:
            while len(queue) < ahead and writer.missing > len(queue) * (length or 1):
                index = writer.episodes + len(queue)
                plan = {
                    "env_seed": derive_seed(seed, "collect", name, index),
                    "action_seed": derive_seed(seed, "collect-actions", name, index),
                    "limit": writer.missing - len(queue),
                }
                with _failures_explained(title := f"episode {index} of {name}"):
                    queue.append((title, pool.submit(_roll, name, plan)))
            title, future = queue.popleft()
            _wait(future, title, steps)
            with _failures_explained(title):
                rollout = pickle.loads(future.result())
            length = length or len(rollout)
            dataset.extend(rollout)
            writer.end_episode()
            bar.reach(writer.transitions)
            bar.show()
    bar.close()


@contextmanager
def _failures_explained(title: str) -> Iterator[None]:
    """Say in an error of the body which episode failed and what the user can do."""
    try:
        yield
    except BrokenProcessPool:
        raise WorkerLostError(
            f"A process that collected {title} has died. Out of memory is the usual cause: use fewer workers. Or a "
            f'script lacks `if __name__ == "__main__":` around its main program, or defines `make` in it. {_AGAIN}.'
        ) from None
    except OSError as reason:
        raise CRPTproError(
            f"The process for {title} cannot be started: {reason}. Use fewer workers, or raise the limit of open files "
            "(`ulimit -n 4096`)."
        ) from reason
    except Exception as reason:
        reason.add_note(f"Collecting {title} failed. {_AGAIN} once the cause is removed.")
        raise


def _wait(future: Future, title: str, steps: Any) -> None:
    """Wait for an episode as long as any worker makes progress."""
    seen, seen_s = -1, 0.0
    while not wait([future], 1.0).done:
        if steps.value != seen:
            seen, seen_s = steps.value, time.monotonic()
        elif time.monotonic() - seen_s > STALL_S:
            raise RenderingError(
                f"The processes that collect {title} have made no step for {STALL_S:.0f} s; a render driver that "
                f"hangs is the usual cause. {_AGAIN}, with fewer workers or another backend (MUJOCO_GL=osmesa, or egl)."
            )


# --- in a worker, or in the only process ------------------------------------------------------------------------------

_make: Callable[[], EnvBase]
_steps: Any
_env: EnvBase | None = None


def _prepare(make: Callable[[], EnvBase], steps: Any) -> None:
    global _make, _steps
    _make, _steps = make, steps


def _roll(name: str, plan: dict[str, int]) -> bytes:
    """Return a planned episode, pickled: torch would otherwise send its tensors as open files."""
    global _env
    # Exceptions of any class are passed on as one that can be pickled.
    with passed_on(name, "rollout"), kept_global_rng():
        _env = _env or _make()  # not in _prepare, whose exceptions a pool only logs
        return pickle.dumps(collect_episode(_env, callback=_count, **plan))


def _count(*_: Any) -> None:
    _steps.value += 1


def _close() -> None:
    global _env
    if _env is not None:
        _env.close()
    _env = None

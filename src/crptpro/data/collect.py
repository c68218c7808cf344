"""Decoupled random collection: a uniform random policy fills one dataset per domain, before any learning."""

from __future__ import annotations

import functools
import logging
import shutil
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from crptpro.cards import require_disk
from crptpro.colors import Colors
from crptpro.data.collect_pool import Worker, WorkerPool
from crptpro.data.collect_progress import CollectProgress
from crptpro.data.collection import DomainCollection
from crptpro.data.incoming import dataset_path
from crptpro.domains import Domain, expand_groups, get_domain
from crptpro.errors import DatasetError
from crptpro.quality import Quality
from crptpro.seeding import require_seed

logger = logging.getLogger(__name__)


def collect_random(
    domain: str | Domain,
    root: str | Path,
    *,
    transitions: int = 100_000,
    seed: int = 0,
    workers: int = 1,
    quality: Quality = "exact",
    colors: Colors = "normal",
    image_size: int = 84,
    action_repeat: int | None = None,
    camera: int | str | None = None,
    stall_timeout_s: float = 300.0,
    progress: bool = True,
) -> Path:
    """Collect one domain's dataset with a uniform random policy, or continue an interrupted collection.

    The paper (section "Decoupled random collection") takes b = 100,000 transitions per domain. See
    :func:`collect_group` for everything else.

    Returns:
        The dataset's directory, ``root/<domain name>``, ready for :meth:`crptpro.data.FrameDataset.open`.
    """
    paths = collect_group(
        [domain],
        root,
        transitions=transitions,
        seed=seed,
        workers=workers,
        quality=quality,
        colors=colors,
        image_size=image_size,
        action_repeat=action_repeat,
        camera=camera,
        stall_timeout_s=stall_timeout_s,
        progress=progress,
    )
    return next(iter(paths.values()))


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
    camera: int | str | None = None,
    stall_timeout_s: float = 300.0,
    progress: bool = True,
) -> dict[str, Path]:
    """Collect the datasets of several domains with one pool of processes shared by all of them.

    Every episode has its own seeds, derived from ``seed``, the domain and the episode's index, so the same
    seed gives the same actions and, on one machine and backend, the same pixels, whatever the number of
    workers and however often the collection was interrupted. The dataset is episodes 0, 1, 2, ... until they
    hold ``transitions`` transitions; the last one is cut to fit, and an endless one after 1000. A complete
    dataset is returned at once.

    The environments live in spawned processes, so a script needs the usual ``if __name__ == "__main__":``.

    Args:
        domains: Domain names, task names, letters of the paper's groups, ``gymnasium:<id>``, or
            :class:`~crptpro.domains.Domain` objects.
        root: A directory ``root/<domain name>`` is made for each domain.
        transitions: Transitions per domain (agent steps; 21 KB each at 84 x 84).
        seed: See above.
        workers: Processes; each renders on one core.
        quality: Render quality, see :func:`crptpro.envs.make_env`.
        colors: Likewise; the episodes are the same in all colours.
        image_size: H = W, pixels.
        action_repeat: Env steps per agent step; the domain's (2) if ``None``.
        camera: The domain's if ``None``.
        stall_timeout_s: Seconds without a sign of life after which a process counts as hung.
        progress: Show a progress line per domain (log lines where the output is no terminal).

    Returns:
        The dataset's directory by domain name.

    Raises:
        DatasetError: if a directory holds something else than what is asked for.
        DiskSpaceError: if the disk cannot hold it; no frame is written then, and the same directory may be asked for
            less.
        UnknownNameError: for a domain nobody knows.
        CRPTproError: if a process fails, dies or hangs; finished episodes are kept.
    """
    if transitions < 1 or workers < 1:
        raise DatasetError(f"transitions and workers must be at least 1, got {transitions} and {workers}.")
    require_seed(seed)
    # Imported late: nothing that reads datasets needs the simulators.
    from crptpro.envs import episode_length, make_env, needs_gl, resolve_action_repeat
    from crptpro.envs.rendering import select_backend

    root = Path(root)
    paths: dict[str, Path] = {}
    drawn_by_gl: set[str] = set()
    factories: dict[str, Callable[[], EnvBase]] = {}
    with ExitStack() as stack:
        collections: dict[str, DomainCollection] = {}
        for domain in map(get_domain, expand_groups(domains)):
            path = dataset_path(root, domain.name)
            if path in paths.values():
                raise DatasetError(f"Two of the domains would be collected into {path}; collect them apart.")
            paths[domain.name] = path
            if needs_gl(domain):
                drawn_by_gl.add(domain.name)
            settings: dict[str, Any] = {
                "image_size": image_size,
                "action_repeat": resolve_action_repeat(domain, action_repeat),
                "camera": domain.camera if camera is None else camera,
                "quality": quality,
                "colors": colors,
            }
            request = {"domain": domain.name, "task": domain.task, "seed": seed, "transitions": transitions}
            length = episode_length(domain, action_repeat=settings["action_repeat"])
            collection = DomainCollection(path, {**request, **settings}, length)
            stack.callback(collection.close)
            collections[domain.name] = collection
            factories[domain.name] = functools.partial(
                make_env, domain, seed=0, frame_stack=1, physics_state=True, **settings
            )
        missing = {name: item for name, item in collections.items() if not item.is_complete}
        for name in collections.keys() - missing.keys():
            logger.info("%s: %s is complete", name, paths[name])
        if missing:
            _announce(missing, root)
            if drawn_by_gl & missing.keys():
                # Proven here once, for as many renderers as will run: some drivers hang when several start together.
                select_backend(processes=workers)
            _run(missing, factories, workers, stall_timeout_s, progress)
    return paths


def _announce(collections: dict[str, DomainCollection], root: Path) -> None:
    sizes = {name: collection.missing_bytes() for name, collection in collections.items()}
    require_disk(root, sum(sizes.values()), f"Collecting {', '.join(sizes)}")
    probe = next(iter(collections.values())).path
    free = shutil.disk_usage(probe).free
    for name, collection in collections.items():
        missing = collection.target - collection.transitions
        logger.info(
            "%s: %.2g GB for %s transitions into %s, %.1f GB free",
            name, sizes[name] / 1e9, f"{missing:,}", collection.path, free / 1e9,
        )  # fmt: skip


def _run(
    collections: dict[str, DomainCollection],
    factories: dict[str, Callable[[], EnvBase]],
    workers: int,
    stall_timeout_s: float,
    progress: bool,
) -> None:
    needed = {name: factories[name] for name in collections}
    lines = CollectProgress(
        {name: collection.target for name, collection in collections.items()},
        {name: collection.transitions for name, collection in collections.items()},
        is_shown=progress,
    )
    with ExitStack() as stack:
        stack.callback(lines.close)
        pool = stack.enter_context(WorkerPool(needed, workers, stall_timeout_s))
        while not all(collection.is_complete for collection in collections.values()):
            for worker in pool.workers:
                if worker.job is None:
                    _give_work(worker, pool, collections)
            for kind, name, payload in pool.messages():
                collection = collections[name]
                was_complete = collection.is_complete
                if kind == "environment":
                    collection.note_environment(payload)
                elif kind == "progress":
                    collection.note_progress(*payload)
                else:
                    collection.accept(*payload)
                lines.update(name, collection.transitions_seen)
                if collection.is_complete and not was_complete:
                    pool.cancel(name)


def _give_work(worker: Worker, pool: WorkerPool, collections: dict[str, DomainCollection]) -> None:
    """Give a free worker an episode of the domain that fewest others work on, its last one if equal."""

    def others(name: str) -> tuple[int, bool]:
        busy = sum(other.job is not None and other.job.domain == name for other in pool.workers)
        return busy, name != worker.last_domain

    for name in sorted(collections, key=others):
        job = collections[name].next_job()
        if job is not None:
            pool.submit(worker, job)
            return

"""Decoupled random collection: a uniform random policy fills one dataset per domain, before any learning."""

from __future__ import annotations

import contextlib
import errno
import functools
import logging
import multiprocessing
import os
import pickle
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing
from multiprocessing.connection import wait as wait_for_process
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.modules import RandomPolicy
from tqdm import tqdm

from crptpro.artifact import require_disk
from crptpro.data.dataset import FrameDataset
from crptpro.domains import LONGEST_EPISODE_AGENT_STEPS, Domain, expand_groups, get_domain
from crptpro.errors import CRPTproError, DatasetError, RenderingError, WorkerLostError
from crptpro.plugins import load_again, loaded_plugins
from crptpro.seeding import derive_seed, kept_global_rng, require_seed
from crptpro.values import Colors, Quality, as_int, as_path

logger = logging.getLogger(__name__)

STALL_S = 300.0
"""Seconds without a step of any worker after which they count as hung."""

Factories = Mapping[str, Callable[[], EnvBase]]
"""Functions that make an environment, by domain."""

_AGAIN = "What was collected is kept: run the same command again"


def collect_random(domain: str | Domain, root: str | Path, **options: Any) -> Path:
    """Collect one domain's dataset as :func:`collect_group` does.

    Returns:
        The dataset's directory, ``root/<domain name>``, ready for :meth:`crptpro.data.FrameDataset.open`.
    """
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
    camera: int | str | None = None,
    progress: bool = True,
) -> dict[str, Path]:
    """Collect the datasets of several domains with a uniform random policy, or continue interrupted collections.

    The paper (section "Decoupled random collection") takes b = 100,000 transitions per domain. Every episode has its
    own seeds, derived from ``seed``, the domain and the episode's index, so the same seed gives the same actions and,
    on one machine and backend, the same pixels, whatever the number of workers and however often the collection was
    interrupted. The last episode is cut to fit, and an endless one after 1000 transitions.

    With several workers the environments live in spawned processes, so a script needs the usual
    ``if __name__ == "__main__":``. A domain whose ``make`` no other process can import, because it was defined in a
    notebook for example, is collected in this one.

    An episode is a rollout of ``RandomPolicy``, not a batch of a TorchRL ``Collector``, which resets before the next
    episode's seeds are known; made to do this, it took 8 % more CPU time with walker (84 x 84, software GL).

    Args:
        domains: domain names, task names, letters of the paper's groups, ``gymnasium:<id>``, or
            :class:`~crptpro.domains.Domain` objects.
        root: a directory ``root/<domain name>`` is made for each domain.
        transitions: transitions per domain (agent steps; 21 KB each at 84 x 84).
        seed: see above.
        workers: processes, each of which renders on one core; 1 is this process.
        quality: render quality, see :func:`crptpro.envs.make_env`.
        colors: likewise; the episodes are the same in all colours.
        image_size: H = W, pixels.
        action_repeat: env steps per agent step; the domain's (2) if ``None``.
        camera: the domain's if ``None``.
        progress: show a progress line per domain (log lines where the output is no terminal).

    Returns:
        The dataset's directory by domain name.

    Raises:
        DatasetError: if a directory holds something else than what is asked for.
        DiskSpaceError: if the disk cannot hold it; no frame is written then, and the same directory may be asked for
            less.
        UnknownNameError: for a domain nobody knows.
        ValueError: for a number or a path that cannot be meant.
        WorkerLostError: if a process dies; finished episodes are kept.
        CRPTproError: if an environment fails or hangs; likewise.
    """
    # Imported late: nothing that reads datasets needs the simulators.
    from crptpro.envs import episode_length, make_env, needs_gl, resolve_action_repeat
    from crptpro.envs.rendering import select_backend

    transitions = as_int(transitions, "transitions", minimum=1)
    workers, seed = as_int(workers, "workers", minimum=1), as_int(seed, "seed")
    require_seed(seed)
    root = as_path(root, "root")
    image_size = as_int(image_size, "image_size", minimum=1)
    repeat = None if action_repeat is None else as_int(action_repeat, "action_repeat", minimum=1)
    paths: dict[str, Path] = {}
    jobs: list[_Collection] = []
    with ExitStack() as stack:
        for domain in map(get_domain, expand_groups(domains)):
            path = dataset_path(root, domain.name)
            if path in paths.values():
                raise DatasetError(f"Two of the domains would be collected into {path}; collect them apart.")
            paths[domain.name] = path
            settings: dict[str, Any] = {
                "image_size": image_size,
                "action_repeat": resolve_action_repeat(domain, repeat),
                "camera": domain.camera if camera is None else camera,
                "quality": quality,
                "colors": colors,
            }
            dataset = FrameDataset.create(
                path, domain=domain.name, transitions=transitions, task=domain.task, seed=seed, **settings
            )
            if dataset.is_complete:
                logger.info("%s: %s is complete", domain.name, path)
                continue
            stack.callback(dataset.writer.close)
            make = functools.partial(make_env, domain, seed=0, frame_stack=1, physics_state=True, **settings)
            length = episode_length(domain, action_repeat=settings["action_repeat"])
            jobs.append(_Collection(domain, dataset, make, seed, length))
        if jobs:
            _announce(jobs, root, image_size)
            workers = _usable_workers(jobs, workers)
            if any(needs_gl(job.domain) for job in jobs):
                # Proven here once, for as many renderers as will run: some drivers hang when several start together.
                select_backend(processes=workers)
            _collect(jobs, workers, progress)
    return paths


def dataset_path(root: str | Path, domain_name: str) -> Path:
    """Return the directory of a domain's dataset: its name, ``-`` for what a file system may refuse."""
    return Path(root) / re.sub(r"[^\w.+-]+", "-", domain_name)


def collect_episode(
    env: EnvBase, *, env_seed: int, action_seed: int, limit: int, callback: Callable[..., Any] | None = None
) -> TensorDictBase:
    """Roll one episode out with a uniform random policy; its two seeds determine it.

    Args:
        env: single frames per observation.
        env_seed: of the simulator.
        action_seed: of the policy, which draws from torch's global generator.
        limit: transitions after which the episode is cut.
        callback: as of TorchRL's ``rollout``.
    """
    env.set_seed(env_seed)
    first = env.reset()
    torch.manual_seed(action_seed)
    policy = RandomPolicy(env.full_action_spec)
    return env.rollout(limit, policy, callback, auto_reset=False, tensordict=first, return_contiguous=True)


# --- the parent ------------------------------------------------------------------------------------------------------


class _Collection:
    """One dataset, and its episodes that run or wait for an earlier one.

    Episodes may finish in any order and are appended in order, so that the dataset depends on the request alone.
    """

    def __init__(
        self,
        domain: Domain,
        dataset: FrameDataset,
        make: Callable[[], EnvBase],
        seed: int,
        length: int | None,
    ):
        self.domain, self.dataset, self.make, self.seed = domain, dataset, make, seed
        self.writer: Any = dataset.writer
        self.usual_length = length
        self.longest = max(LONGEST_EPISODE_AGENT_STEPS, length or 0)
        self.running: set[int] = set()
        self.waiting: dict[int, TensorDictBase] = {}

    @property
    def missing(self) -> int:
        """Transitions that are not durable yet."""
        return self.writer.target - self.writer.transitions

    def next_plan(self, ahead: int) -> dict[str, Any] | None:
        """Return the next episode worth starting, at most ``ahead`` under way; ``None`` if those should suffice."""
        first = index = self.writer.episodes
        wanted = limit = self.missing
        while index in self.running or index in self.waiting:
            known = len(self.waiting[index]) if index in self.waiting else None
            wanted -= known or self.usual_length or 1
            limit -= known or 1  # a running one has at least one transition
            index += 1
        if wanted <= 0 or index - first >= ahead:
            return None
        self.running.add(index)
        name = self.domain.name
        return {
            "domain": name,
            "episode": index,
            "env_seed": derive_seed(self.seed, "collect", name, index),
            "action_seed": derive_seed(self.seed, "collect-actions", name, index),
            "limit": min(limit, self.longest),
        }

    def accept(self, index: int, card: Mapping[str, Any], rollout: TensorDictBase) -> None:
        """Take a finished episode; it and those that waited for it are durable when this returns."""
        self.running.discard(index)
        if self.dataset.is_complete:
            return
        self.writer.note_environment(card)
        self.waiting[index] = rollout
        while not self.dataset.is_complete and self.writer.episodes in self.waiting:
            episode = self.waiting.pop(self.writer.episodes)
            self.usual_length = self.usual_length or len(episode)
            self.dataset.extend(episode)
            self.writer.end_episode()
        if self.dataset.is_complete:
            self.waiting.clear()


def _announce(jobs: list[_Collection], root: Path, image_size: int) -> None:
    """Say how much will be written (action and state: at most 1 kB each), and refuse what the disk cannot hold."""
    sizes = {}
    for job in jobs:
        frames = job.missing + -(-job.missing // (job.usual_length or 100))  # one more per episode
        sizes[job.domain.name] = frames * 3 * image_size**2 + job.missing * 1000
    require_disk(root, sum(sizes.values()), f"Collecting {', '.join(sizes)}")
    free = shutil.disk_usage(jobs[0].dataset.path).free
    for job in jobs:
        name = job.domain.name
        logger.info(
            "%s: %.2g GB for %s transitions into %s, %.1f GB free",
            name, sizes[name] / 1e9, f"{job.missing:,}", job.dataset.path, free / 1e9,
        )  # fmt: skip


def _usable_workers(jobs: list[_Collection], workers: int) -> int:
    """Return 1, and say why, where another process could not import a domain's ``make``."""
    main_file = getattr(sys.modules.get("__main__"), "__file__", None)
    for job in jobs if workers > 1 else ():
        try:
            is_lost = b"__main__" in pickle.dumps(job.make) and not (main_file and Path(main_file).exists())
        except Exception:  # objects may refuse in ways of their own
            is_lost = True
        if is_lost:
            logger.warning(
                "%s is collected in this process: no other one can import its `make`, no function of a module.",
                job.domain.name,
            )
            return 1
    return workers


def _collect(jobs: list[_Collection], workers: int, progress: bool) -> None:
    factories = {job.domain.name: job.make for job in jobs}
    with ExitStack() as stack:
        bars = [stack.enter_context(closing(_Progress(job, progress))) for job in jobs]
        pool: Any = _Pool(factories, workers) if workers > 1 else _ThisProcess(factories)
        stack.enter_context(closing(pool))
        running: dict[Future, tuple[_Collection, int, int]] = {}
        while any(not job.dataset.is_complete for job in jobs):
            for job in jobs:  # all workers on the first that needs one: each makes each environment once
                while len(running) < workers and (plan := job.next_plan(4 * workers)) is not None:
                    slot = min(set(range(workers)) - {taken for *_, taken in running.values()})
                    running[pool.submit(plan, slot)] = (job, plan["episode"], slot)
            for future in pool.finished(running):
                job, episode, _ = running.pop(future)
                result = future.result()
                job.accept(episode, *(pickle.loads(result) if isinstance(result, bytes) else result))
            for bar in bars:
                bar.show(sum(pool.steps[slot] for job, _, slot in running.values() if job is bar.job))


class _ThisProcess:
    """Collects where it is called."""

    def __init__(self, factories: Factories):
        self.steps = [0]
        self._roller = _Roller(factories, self.steps)

    def submit(self, plan: dict[str, Any], slot: int) -> Future:
        future: Future = Future()
        with kept_global_rng():
            future.set_result(self._roller.roll(plan, slot))
        return future

    def finished(self, running: Mapping[Future, Any]) -> list[Future]:
        return list(running)

    def close(self) -> None:
        self._roller.close()


class _Pool:
    """Collects in spawned processes, never forked ones: a fork would share a GL context."""

    def __init__(self, factories: Factories, workers: int):
        self._context = multiprocessing.get_context("spawn")
        self.workers, self.steps = workers, self._context.RawArray("q", workers)
        self._arguments = (factories, loaded_plugins(), self.steps)
        self._executor: ProcessPoolExecutor | None = None
        self._processes: dict[int, Any] = {}
        self._sign: tuple[list[int], float] = ([], time.monotonic())

    def submit(self, plan: dict[str, Any], slot: int) -> Future:
        try:
            if self._executor is None:
                self._executor = ProcessPoolExecutor(
                    self.workers, self._context, _start_worker, self._arguments
                )
            with _interrupts_ignored():
                return self._executor.submit(_work, plan, slot)
        except BrokenProcessPool:
            raise self._lost(f"episode {plan['episode']} of {plan['domain']}") from None
        except OSError as reason:
            hint = "Use fewer workers."
            if reason.errno == errno.EMFILE:
                import resource

                limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
                hint = f"This shell allows {limit} open files: raise that (`ulimit -n 4096`), or use fewer workers."
            raise CRPTproError(
                f"{self.workers} collecting processes cannot be started: {reason}. {hint}"
            ) from reason
        finally:
            self._processes |= getattr(self._executor, "_processes", None) or {}

    def finished(self, running: Mapping[Future, tuple[_Collection, int, int]]) -> list[Future]:
        """Wait a second for episodes, and make sure that somebody works."""
        done = list(wait(running, 1.0, FIRST_COMPLETED).done)
        episodes = ", ".join(
            f"episode {episode} of {job.domain.name}" for job, episode, _ in running.values()
        )
        if any(isinstance(future.exception(), BrokenProcessPool) for future in done):
            raise self._lost(episodes)
        before, since_s = self._sign
        if done or list(self.steps) != before:
            self._sign = (list(self.steps), time.monotonic())
        elif time.monotonic() - since_s > STALL_S:
            raise RenderingError(
                f"The processes that collect {episodes} have given no sign of life for {STALL_S:.0f} s; a render "
                f"driver that hangs is the usual cause. {_AGAIN}, with fewer workers or another backend "
                "(MUJOCO_GL=osmesa, or egl)."
            )
        return done

    def _lost(self, episodes: str) -> WorkerLostError:
        for process in self._processes.values():
            process.join(2.0)
        codes = [process.exitcode for process in self._processes.values()]
        # Those that the executor ended after the first have been terminated.
        code = next((code for code in codes if code not in (None, 0, -signal.SIGTERM)), -signal.SIGTERM)
        how = f"was killed by signal {-code}" if code < 0 else f"exited with status {code}"
        hint = "Look at the messages above."
        if code == -signal.SIGKILL:
            hint = "Out of memory is the usual cause of signal 9: use fewer workers."
        elif not any(self.steps):
            hint = (
                'A script that collects needs `if __name__ == "__main__":` around its main program, because the '
                "processes import it; otherwise look at the messages above."
            )
        return WorkerLostError(f"A process that collected ({episodes}) {how}. {hint} {_AGAIN}.")

    def close(self) -> None:
        # What still runs is no longer wanted, or has lost its parent's interest by an error or Ctrl-C.
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.join(5.0)
            if process.is_alive():
                process.kill()
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Let a process that is started inside ignore Ctrl-C from its first moment; the parent decides what it ends."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Progress:
    """Transitions of one dataset: a bar on a terminal, a log line per tenth elsewhere."""

    def __init__(self, job: _Collection, is_shown: bool):
        self.job, self._is_shown = job, is_shown
        self._total, self._count = job.writer.target, job.writer.transitions
        self._begun: tuple[float, int] | None = None
        self._bar = tqdm(
            total=self._total, initial=self._count, desc=job.domain.name, unit=" transitions", dynamic_ncols=True,
            disable=None if is_shown else True, smoothing=0.05,
        )  # fmt: skip

    def show(self, running: int) -> None:
        running += self.job.writer.transitions + sum(map(len, self.job.waiting.values()))
        count, before = min(self._total, running), self._count
        if count <= before:
            return
        self._count = count
        self._bar.update(count - before)
        begun_s, first = self._begun = self._begun or (time.monotonic(), before)
        if self._is_shown and self._bar.disable and 10 * count // self._total > 10 * before // self._total:
            rate = (count - first) / max(time.monotonic() - begun_s, 1e-9)
            logger.info(
                "%s: %s of %s transitions, %.1f transitions/s, %.0f s left",
                self.job.domain.name, f"{count:,}", f"{self._total:,}", rate, (self._total - count) / rate,
            )  # fmt: skip

    def close(self) -> None:
        self._bar.close()


# --- where episodes are rolled out -----------------------------------------------------------------------------------


class _Roller:
    """Rolls out planned episodes, in the environment of one domain at a time; ``steps`` counts them in their slots."""

    def __init__(self, factories: Factories, steps: Any):
        self._factories, self._steps = factories, steps
        self._domain = ""
        self._env: Any = None

    def roll(self, plan: Mapping[str, Any], slot: int) -> tuple[dict[str, Any], TensorDictBase]:
        """Return the environment's card and the episode."""
        self._steps[slot] = 0

        def count(*_: Any) -> None:
            self._steps[slot] += 1

        try:
            if self._env is None or plan["domain"] != self._domain:
                self.close()
                self._env, self._domain = self._factories[plan["domain"]](), plan["domain"]
            seeds = {name: plan[name] for name in ("env_seed", "action_seed", "limit")}
            rollout = collect_episode(self._env, callback=count, **seeds)
        except CRPTproError:
            raise
        except Exception as reason:
            raise CRPTproError(
                f"Episode {plan['episode']} of {plan['domain']} failed: {str(reason).strip() or repr(reason)}. "
                f"{_AGAIN} once the cause is removed."
            ) from reason
        return (self._env.card() if hasattr(self._env, "card") else {}), rollout

    def close(self) -> None:
        """Close the environment and free its render context."""
        if self._env is not None:
            self._env.close()
        self._env = None


_roller: _Roller
_plugins: tuple[str, ...]


def _start_worker(factories: Factories, plugins: tuple[str, ...], steps: Any) -> None:
    global _roller, _plugins
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C ends
    # One software-rendering thread per process is faster than several; it must be set before GL loads.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    _roller, _plugins = _Roller(factories, steps), plugins


def _work(plan: Mapping[str, Any], slot: int) -> bytes:
    load_again(_plugins)  # a world that they register in Gymnasium has no name in this process yet
    # As bytes: torch would send tensors as open files, which are gone with the process.
    return pickle.dumps(_roller.roll(plan, slot))


def _exit_with_parent() -> None:
    """End this process when its parent has ended, however it ended: nobody wants the episode any more."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for_process([parent.sentinel])
        os._exit(1)

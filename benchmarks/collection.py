"""Collection of pixels: TorchRL's ``DMControlEnv`` and ``Collector`` beside ours, per core, and ours with workers.

``python -m benchmarks.collection`` compares like with like, in one process that is held on one core, the renderer on
one thread (``LP_NUM_THREADS=1``), domain by domain, blocks of transitions in turns:

* environments alone: single frames, nothing stored. TorchRL's render at every env step, so twice per agent step at an
  action repeat of 2, with a camera made anew for every image.
* collecting: TorchRL's ``Collector`` fills a ``LazyMemmapStorage`` with single frames. Ours is what ``collect_random``
  does, every block an episode: physical state, files synced to the disk. Between them, our environment and
  ``FrameDataset.extend`` with TorchRL's ``Collector``.

Then ``collect_random`` with several worker processes.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, ReplayBuffer
from torchrl.envs import DMControlWrapper, EnvBase
from torchrl.modules import RandomPolicy

from benchmarks.measure import Timing, ratios, save, side_by_side, timing_of
from crptpro.console import run_main
from crptpro.data import FrameDataset, collect_random
from crptpro.data.collect import collect_episode
from crptpro.domains import SUITE_TASKS, get_domain
from crptpro.envs import make_env
from crptpro.envs.rendering import backend_card, select_backend
from crptpro.errors import CRPTproError
from crptpro.values import Quality

TORCHRL = "TorchRL"
EXACT, FAST = "crptpro, exact", "crptpro, fast"
MIXED = "crptpro, exact, TorchRL's Collector"
QUALITIES: dict[str, Quality] = {EXACT: "exact", FAST: "fast"}


@dataclass(frozen=True)
class Settings:
    """What to compare and how often."""

    domains: tuple[str, ...] = ("cheetah", "walker", "quadruped")
    """domains of dm_control's suite"""
    block: int = 100
    """transitions of one timed block"""
    rounds: int = 7
    """timed blocks of each candidate, taken in turns"""
    image_size: int = 84
    """height and width in pixels"""
    workers: tuple[int, ...] = (1, 2)
    """numbers of collecting processes; none to leave this part out"""
    worker_transitions: int = 4_000
    """how much each number of them collects of the first domain, best a multiple of the largest number times 500"""
    scratch: Path | None = None
    """where frames are written for the time being; the system's temporary directory by default"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces storages on standard output
    os.environ["LP_NUM_THREADS"] = "1"
    select_backend(processes=max(settings.workers, default=1))
    results: dict[str, Any] = {"render": backend_card()}
    print("| domain | what | candidate | transitions/s | times TorchRL |\n|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory(prefix="crptpro-collection-", dir=settings.scratch) as work, one_core():
        for domain in settings.domains:
            torch.manual_seed(0)
            for what, timings in compare(domain, settings, Path(work) / domain):
                faster = {name: 1 / ratio for name, ratio in ratios(timings, to=TORCHRL).items()}
                for name, timing in timings.items():
                    rate = f"{1 / timing.median_s:.1f} | {faster[name]:.2f}"
                    print(f"| {domain} | {what} | {name} | {rate} |", flush=True)
                results.setdefault(what, {})[domain] = {"timings": timings, "times_torchrl": faster}
    results["workers"] = time_workers(settings)
    save("collection", settings, results, out=settings.out)
    return results


def compare(domain: str, settings: Settings, work: Path) -> Iterator[tuple[str, dict[str, Timing]]]:
    """Time one domain's environments alone, then collecting."""
    size, block = settings.image_size, settings.block
    own = functools.partial(make_env, domain, seed=0, frame_stack=1, image_size=size)
    timed = functools.partial(side_by_side, rounds=settings.rounds, warmup=1, per_call=block)
    with contextlib.ExitStack() as stack:
        envs = {
            TORCHRL: torchrl_env(domain, image_size=size),
            EXACT: own(quality="exact"),
            FAST: own(quality="fast"),
        }
        for env in envs.values():
            stack.callback(env.close)
        yield "environment alone", timed({name: stepper(env, block) for name, env in envs.items()})
    with contextlib.ExitStack() as stack:
        storage = LazyMemmapStorage(block * (settings.rounds + 1), scratch_dir=work / "torchrl")
        stock = stack.enter_context(
            collector(
                torchrl_env(domain, image_size=size), block, replay_buffer=ReplayBuffer(storage=storage)
            )
        )
        calls: dict[str, Callable[[], Any]] = {TORCHRL: lambda: next(stock)}
        ours = stack.enter_context(collector(own(physics_state=True), block))
        mixed = FrameDataset.create(work / "mixed", domain=domain, transitions=2**31)
        stack.callback(mixed.writer.close)
        calls[MIXED] = lambda: mixed.extend(next(ours))
        for name, quality in QUALITIES.items():
            env = own(quality=quality, physics_state=True)
            dataset = FrameDataset.create(work / quality, domain=domain, transitions=2**31)
            stack.callback(env.close)
            stack.callback(dataset.writer.close)
            calls[name] = functools.partial(collect_block, env, dataset, block)
        yield "collecting", timed(calls)


def stepper(env: EnvBase, transitions: int) -> Callable[[], None]:
    """Return a call that steps an environment at random so many times, resetting it where an episode ends."""
    policy = RandomPolicy(env.full_action_spec)
    state = env.reset()

    def step() -> None:
        nonlocal state
        for _ in range(transitions):
            _, state = env.step_and_maybe_reset(policy(state))

    return step


def torchrl_env(domain: str, *, image_size: int) -> EnvBase:
    """Build TorchRL's environment at the image size, camera and action repeat that this library uses.

    ``DMControlEnv`` hands ``render_kwargs`` on to dm_control's task, which refuses it, so the size is given to the
    wrapper below it, ``DMControlWrapper``; they are the same environment otherwise.

    Raises:
        CRPTproError: for a domain that is not of dm_control's suite.
    """
    found = get_domain(domain)
    world = next((world for world, tasks in SUITE_TASKS.items() if found.task in tasks), None)
    if found.source != "suite" or world is None:
        raise CRPTproError(f"TorchRL's DMControlEnv knows dm_control's suite only; {domain!r} is not of it.")
    select_backend()
    from dm_control import suite  # after the choice of the render backend, which it reads

    env = suite.load(world, found.task.removeprefix(f"{world}_"), task_kwargs={"random": 0})
    return DMControlWrapper(
        env, from_pixels=True, pixels_only=True, frame_skip=found.action_repeat, camera_id=found.camera,
        render_kwargs={"height": image_size, "width": image_size},
    )  # fmt: skip


@contextlib.contextmanager
def collector(env: EnvBase, block: int, **options: Any) -> Iterator[Iterator[Any]]:
    """Yield the batches of TorchRL's ``Collector`` with a random policy."""
    policy = RandomPolicy(env.full_action_spec)
    found = Collector(env, policy, frames_per_batch=block, total_frames=-1, **options)
    try:
        yield iter(found)
    finally:
        found.shutdown()


def collect_block(env: EnvBase, dataset: FrameDataset, transitions: int) -> None:
    """Collect one episode as ``collect_random`` does."""
    seed = dataset.writer.episodes
    dataset.extend(collect_episode(env, env_seed=seed, action_seed=seed, limit=transitions))
    dataset.writer.end_episode()


def time_workers(settings: Settings) -> dict[int, dict[str, Timing]]:
    """Collect with each number of workers, in turns, twice; print transitions/s whole and without the start."""
    found: dict[int, dict[str, list[float]]] = {n: {"whole": [], "running": []} for n in settings.workers}
    total = settings.worker_transitions

    def seconds_of(transitions: int, workers: int) -> float:
        with tempfile.TemporaryDirectory(prefix="crptpro-collection-", dir=settings.scratch) as root:
            start = time.perf_counter()
            collect_random(
                settings.domains[0], root, transitions=transitions, workers=workers, progress=False
            )
            return time.perf_counter() - start

    for _ in range(2 if settings.workers else 0):
        for count, seconds in found.items():
            whole = seconds_of(total, count)
            seconds["whole"].append(whole / total)
            first = 500 * count  # each worker's first episode
            if first < total:
                seconds["running"].append((whole - seconds_of(first, count)) / (total - first))
    timings = {n: {k: timing_of(v) for k, v in seconds.items() if v} for n, seconds in found.items()}
    if timings:
        print("\n| workers | transitions/s, running | with start |\n|---|---|---|")
    for count, timing in timings.items():
        rates = [
            f"{1 / timing[kind].median_s:.1f}" if kind in timing else "" for kind in ("running", "whole")
        ]
        print(f"| {count} | {' | '.join(rates)} |")
    return timings


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Hold this process, and the threads it starts meanwhile, on one core; torch on one thread."""
    threads = torch.get_num_threads()
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    torch.set_num_threads(1)
    if cores:
        os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        if cores:
            os.sched_setaffinity(0, cores)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

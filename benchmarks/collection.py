"""Collection of pixels: TorchRL's ``DMControlEnv`` and ``Collector`` beside ours, per core, and ours with workers.

``python -m benchmarks.collection`` compares like with like, in one process that is held on one core, the renderer on
one thread (``LP_NUM_THREADS=1``), domain by domain, in turns:

* environments alone: single frames, nothing stored. TorchRL's render at every env step, so twice per agent step at an
  action repeat of 2, with a camera made anew for every image.
* collecting: TorchRL's ``Collector`` fills a ``LazyMemmapStorage`` with single frames; ours is ``collect_random``, its
  start included, with physical state and files synced to the disk.

Then ``collect_random`` with several worker processes.
"""

from __future__ import annotations

import functools
import itertools
import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, ReplayBuffer
from torchrl.envs import DMControlWrapper, EnvBase
from torchrl.modules import RandomPolicy

from benchmarks.measure import save, side_by_side, table
from crptpro.console import run_main
from crptpro.data import collect_random
from crptpro.domains import get_domain
from crptpro.envs import make_env
from crptpro.values import Quality

TORCHRL = "TorchRL"
QUALITIES: tuple[Quality, ...] = ("exact", "fast")


@dataclass(frozen=True)
class Settings:
    """What to compare and how often."""

    domains: tuple[str, ...] = ("cheetah", "walker", "quadruped")
    """domains of dm_control's suite"""
    block: int = 500
    """transitions of one timed block"""
    rounds: int = 5
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
    results: dict[str, Any] = {}
    threads, cores = torch.get_num_threads(), os.sched_getaffinity(0)
    with tempfile.TemporaryDirectory(prefix="crptpro-collection-", dir=settings.scratch) as directory:
        torch.set_num_threads(1)
        os.sched_setaffinity(0, {max(cores)})
        try:
            for domain in settings.domains:
                results[domain] = compare(domain, settings, Path(directory) / domain)
        finally:
            torch.set_num_threads(threads)
            os.sched_setaffinity(0, cores)
        total, domain = settings.worker_transitions, settings.domains[0]
        calls = {
            f"{count} workers": collecting(domain, Path(directory) / str(count), total, settings, workers=count)
            for count in settings.workers
        }
        if calls:
            timings = side_by_side(calls, rounds=2, warmup=0, per_call=total)
            results["workers"] = table(timings, unit=f"transition of {domain}, with the start", to=next(iter(calls)))
    save("collection", settings, results, settings.out)
    return results


def compare(domain: str, settings: Settings, place: Path) -> dict[str, Any]:
    """Time one domain's environments alone, then collecting."""
    size, block = settings.image_size, settings.block
    timed = functools.partial(side_by_side, rounds=settings.rounds, warmup=1, per_call=block)
    own = functools.partial(make_env, domain, seed=0, frame_stack=1, image_size=size)
    envs = {TORCHRL: torchrl_env(domain, size), **{f"crptpro, {q}": own(quality=q) for q in QUALITIES}}
    alone = timed({name: stepper(env, block) for name, env in envs.items()})
    for env in envs.values():
        env.close()
    found = {"environment": table(alone, unit=f"transition of {domain}, environment alone", to=TORCHRL)}

    storage = LazyMemmapStorage(block * (settings.rounds + 1), scratch_dir=place / "torchrl")
    env = torchrl_env(domain, size)
    collector = Collector(
        env, RandomPolicy(env.full_action_spec), frames_per_batch=block, total_frames=-1,
        replay_buffer=ReplayBuffer(storage=storage),
    )  # fmt: skip
    batches = iter(collector)
    calls: dict[str, Callable[[], Any]] = {TORCHRL: lambda: next(batches)}
    for quality in QUALITIES:
        calls[f"crptpro, {quality}"] = collecting(domain, place / quality, block, settings, quality=quality)
    found["collecting"] = table(timed(calls), unit=f"transition of {domain}, collecting", to=TORCHRL)
    collector.shutdown()
    return found


def collecting(domain: str, root: Path, transitions: int, settings: Settings, **options: Any) -> Callable[[], Any]:
    """Return a call that collects a dataset in a directory of its own."""
    numbers = itertools.count()
    sizes = {"transitions": transitions, "image_size": settings.image_size, "progress": False}
    return lambda: collect_random(domain, root / str(next(numbers)), **sizes, **options)


def stepper(env: EnvBase, transitions: int) -> Callable[[], None]:
    """Return a call that steps an environment at random so many times, resetting it where an episode ends."""
    policy = RandomPolicy(env.full_action_spec)
    state = env.reset()

    def step() -> None:
        nonlocal state
        for _ in range(transitions):
            _, state = env.step_and_maybe_reset(policy(state))

    return step


def torchrl_env(domain: str, image_size: int) -> EnvBase:
    """Build TorchRL's environment at the image size, camera and action repeat that this library uses.

    ``DMControlEnv`` hands ``render_kwargs`` on to dm_control's task, which refuses it, so the size is given to the
    wrapper below it, ``DMControlWrapper``; they are the same environment otherwise.
    """
    found = get_domain(domain)
    make_env(domain, seed=0).close()  # chooses the render backend, which dm_control reads when it is imported
    from dm_control import suite

    world = max((name for name in suite.TASKS_BY_DOMAIN if found.task.startswith(f"{name}_")), key=len)
    env = suite.load(world, found.task.removeprefix(f"{world}_"), task_kwargs={"random": 0})
    return DMControlWrapper(
        env, from_pixels=True, pixels_only=True, frame_skip=found.action_repeat, camera_id=found.camera,
        render_kwargs={"height": image_size, "width": image_size},
    )  # fmt: skip


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

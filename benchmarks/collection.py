"""Collection of pixels: TorchRL's ``DMControlEnv`` and ``Collector`` beside ours, per core, and ours with workers.

``python -m benchmarks.collection`` holds its process on one core, the renderer on one thread (``LP_NUM_THREADS=1``).
Domain by domain, in turns, TorchRL's ``Collector`` fills a ``LazyMemmapStorage`` with single frames, and
``collect_random`` a dataset: its start included, with physical state, and files synced to the disk. TorchRL's
environment renders at every env step, so twice per agent step at an action repeat of 2, with a new camera per image.

Then ``collect_random`` runs with several worker processes.
"""

from __future__ import annotations

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

from benchmarks import measure
from crptpro.console import run_main
from crptpro.data import collect_random
from crptpro.domains import get_domain
from crptpro.envs import make_env

TORCHRL = "TorchRL"


@dataclass(frozen=True, kw_only=True)
class Settings(measure.Settings):
    """What to compare and how often."""

    domains: tuple[str, ...] = ("cheetah", "walker", "quadruped")
    """domains of dm_control's suite"""
    block: int = 500
    """transitions of one timed block"""
    rounds: int = 5
    """timed blocks of each candidate, taken in turns"""
    workers: tuple[int, ...] = (1, 2)
    """numbers of collecting processes; none to leave this part out"""
    worker_transitions: int = 4_000
    """transitions of the first domain for each number of processes, best a multiple of the largest one times 500"""


def main(settings: Settings) -> None:
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces storages on standard output
    os.environ["LP_NUM_THREADS"] = "1"
    results: dict[str, Any] = {}
    threads, cores = torch.get_num_threads(), os.sched_getaffinity(0)
    with tempfile.TemporaryDirectory(prefix="crptpro-collection-", dir=settings.scratch) as directory:
        torch.set_num_threads(1)
        os.sched_setaffinity(0, {max(cores)})
        try:
            for domain in settings.domains:
                results[domain] = compare_collecting(domain, settings, Path(directory) / domain)
        finally:
            torch.set_num_threads(threads)
            os.sched_setaffinity(0, cores)
        total, domain = settings.worker_transitions, settings.domains[0]
        calls = {
            f"{count} workers": collecting(domain, Path(directory) / str(count), total, settings, workers=count)
            for count in settings.workers
        }
        if calls:
            unit = f"transition of {domain}, with the start"
            results["workers"] = measure.compare(
                calls, unit=unit, rounds=2, warmup=0, per_call=total, to=next(iter(calls))
            )
    measure.save("collection", settings, results)


def compare_collecting(domain: str, settings: Settings, place: Path) -> dict[str, Any]:
    block, env = settings.block, torchrl_env(domain, settings.image_size)
    storage = LazyMemmapStorage(block * (settings.rounds + 1), scratch_dir=place / "torchrl")
    collector = Collector(
        env, RandomPolicy(env.full_action_spec), frames_per_batch=block, total_frames=-1,
        replay_buffer=ReplayBuffer(storage=storage),
    )  # fmt: skip
    batches = iter(collector)
    calls: dict[str, Callable[[], Any]] = {TORCHRL: lambda: next(batches)}
    for quality in ("exact", "fast"):
        calls[f"crptpro, {quality}"] = collecting(domain, place / quality, block, settings, quality=quality)
    found = measure.compare(
        calls, unit=f"transition of {domain}", rounds=settings.rounds, warmup=1, per_call=block, to=TORCHRL
    )
    collector.shutdown()
    return found


def collecting(domain: str, root: Path, transitions: int, settings: Settings, **options: Any) -> Callable[[], Any]:
    """Return a call that collects a dataset, each time into a new directory."""
    numbers = itertools.count()
    sizes = {"transitions": transitions, "image_size": settings.image_size, "progress": False}
    return lambda: collect_random(domain, root / str(next(numbers)), **sizes, **options)


def torchrl_env(domain: str, image_size: int) -> EnvBase:
    """Build TorchRL's environment at the image size, camera and action repeat that this library uses.

    ``DMControlEnv`` passes ``render_kwargs`` on to dm_control's task, which refuses it, so the size is given to the
    wrapper below it, ``DMControlWrapper``; they are the same environment otherwise.
    """
    found = get_domain(domain)
    make_env(domain, seed=0).close()  # chooses the render backend, which dm_control reads when it is imported
    from dm_control import suite

    env = suite.load(found.name, found.task.removeprefix(f"{found.name}_"), task_kwargs={"random": 0})
    return DMControlWrapper(
        env, from_pixels=True, pixels_only=True, frame_skip=found.action_repeat, camera_id=found.camera,
        render_kwargs={"height": image_size, "width": image_size},
    )  # fmt: skip


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

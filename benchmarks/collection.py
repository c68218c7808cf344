"""Collection of pixels: TorchRL's ``DMControlEnv`` beside ours, per core, and ours with several workers.

``python -m benchmarks.collection`` compares like with like, in one process that is held on one core, the renderer on
one thread (``LP_NUM_THREADS=1``), domain by domain, blocks of transitions in turns:

* environments alone: single frames, nothing stored. Ours turn the image to ``[C, H, W]`` and numbers to float32,
  which TorchRL's leave to transforms.
* collecting: TorchRL's ``Collector`` fills a ``LazyMemmapStorage`` with single frames. Ours is what ``collect_random``
  does in a worker and its parent: every block is an episode of its own (one more image, for its first observation),
  its physical state, checksums, and files synced to the disk.

Neither stacks frames. CPU time stands beside wall time: it shows that no candidate had more than its core. The rest
is ``collect_random`` as it is, with its processes.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarks.collecting_ways import OwnCollection, StockCollection, documented_env, stepper, stock_env
from benchmarks.collecting_workers import worker_rates, worker_table
from benchmarks.measure import Timing, ratios, save, side_by_side
from crptpro.console import run_main
from crptpro.envs import make_env
from crptpro.envs.rendering import backend_card, select_backend
from crptpro.quality import Quality

logger = logging.getLogger("crptpro.benchmarks.collection")

STOCK = "TorchRL"
EXACT, FAST = "crptpro, exact", "crptpro, fast"
DOCUMENTED = "TorchRL `DMControlEnv`, 240 x 320"
TARGETS = {EXACT: 2.0, FAST: 3.5}


@dataclass(frozen=True)
class Settings:
    """What to compare and how often."""

    domains: tuple[str, ...] = ("cheetah", "walker", "quadruped")
    """domains of dm_control's suite"""
    block: int = 100
    """transitions of one timed block"""
    rounds: int = 7
    """timed blocks of each candidate, taken in turns"""
    warmup: int = 1
    """blocks of each candidate before the first timed one"""
    image_size: int = 84
    """height and width in pixels"""
    action_repeat: int = 2
    """env steps per transition"""
    workers: tuple[int, ...] = (1, 2)
    """numbers of collecting processes; the ratios are to the first; none to leave this part out"""
    pool_domain: str = "cheetah"
    """what they collect"""
    pool_transitions: int = 4_000
    """how much each of them collects, best a multiple of the largest number times an episode of 500"""
    pool_rounds: int = 2
    """collections of each number of workers, taken in turns"""
    pool_quality: Quality = "exact"
    """their render quality"""
    scratch: Path | None = None
    """where frames are written for the time being; the system's temporary directory by default"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces storages on standard output
    os.environ["LP_NUM_THREADS"] = "1"
    select_backend(processes=max(settings.workers, default=1))
    alone: dict[str, dict[str, Rate]] = {}
    stored: dict[str, dict[str, Rate]] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-collection-", dir=settings.scratch) as work:
        with one_core():
            for domain in settings.domains:
                logger.info("%s, on one core", domain)
                alone[domain], stored[domain] = _compare(domain, settings, Path(work) / domain)
        logger.info("%s, with %s workers", settings.pool_domain, settings.workers)
        pool = worker_rates(
            settings.pool_domain,
            Path(work),
            workers=settings.workers,
            transitions=settings.pool_transitions,
            rounds=settings.pool_rounds,
            quality=settings.pool_quality,
        )
    results: dict[str, Any] = {
        "environment alone": {domain: _as_json(rates) for domain, rates in alone.items()},
        "collecting": {domain: _as_json(rates) for domain, rates in stored.items()},
        "workers": pool,
        "render": backend_card(),
        "lp_num_threads": os.environ["LP_NUM_THREADS"],
    }
    save("collection", settings, results, out=settings.out)
    print(f"\n`python -m benchmarks.collection {' '.join(sys.argv[1:])}`\n")
    print(f"One core, {results['render']['gl_renderer']}, LP_NUM_THREADS=1\n")
    print(_core_table({"environment alone": alone, "collecting": stored}))
    if pool:
        print(f"\n`collect_random`, {settings.pool_domain}, {settings.pool_quality}\n")
        print(worker_table(pool))
    return results


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


@dataclass(frozen=True)
class Rate:
    """How fast one candidate is.

    Args:
        block: wall times of one block.
        per_s: transitions per second of wall time, median.
        cpu_ms: milliseconds of CPU time per transition, all threads, median; steadier where the core is shared.
        times_stock: times the transitions per second of TorchRL.
    """

    block: Timing
    per_s: float
    cpu_ms: float
    times_stock: float


def _compare(domain: str, settings: Settings, work: Path) -> tuple[dict[str, Rate], dict[str, Rate]]:
    """Return the rates of environments alone, and of collecting."""
    size, repeat, block = settings.image_size, settings.action_repeat, settings.block
    stock = functools.partial(stock_env, domain, image_size=size, action_repeat=repeat)
    own = functools.partial(make_env, domain, seed=0, frame_stack=1, image_size=size, action_repeat=repeat)
    torch.manual_seed(0)
    with contextlib.ExitStack() as stack:
        envs = {
            STOCK: stock(),
            DOCUMENTED: documented_env(domain, action_repeat=repeat),
            EXACT: own(quality="exact"),
            FAST: own(quality="fast"),
        }
        for env in envs.values():
            stack.callback(env.close)
        alone = _rates({name: stepper(env, block) for name, env in envs.items()}, settings)
    with contextlib.ExitStack() as stack:
        capacity = block * (settings.rounds + settings.warmup)
        collections: dict[str, StockCollection | OwnCollection] = {
            STOCK: StockCollection(stock(), transitions=block, scratch=work / "stock", capacity=capacity)
        }
        for name, quality in ((EXACT, "exact"), (FAST, "fast")):
            with_state = functools.partial(own, quality=quality, physics_state=True)
            collections[name] = OwnCollection(with_state, transitions=block, root=work / quality)
        for collection in collections.values():
            stack.callback(collection.close)
        return alone, _rates({name: item.collect for name, item in collections.items()}, settings)


def _rates(calls: Mapping[str, Callable[[], None]], settings: Settings) -> dict[str, Rate]:
    cpu_s: dict[str, list[float]] = {name: [] for name in calls}

    def noting_cpu(name: str, call: Callable[[], None]) -> Callable[[], None]:
        def noted() -> None:
            start = time.process_time()
            call()
            cpu_s[name].append(time.process_time() - start)

        return noted

    noted = {name: noting_cpu(name, call) for name, call in calls.items()}
    timings = side_by_side(noted, rounds=settings.rounds, warmup=settings.warmup)
    slower = ratios(timings, to=STOCK)
    return {
        name: Rate(
            block=timing,
            per_s=settings.block / timing.median_s,
            cpu_ms=1e3 * statistics.median(cpu_s[name][settings.warmup :]) / settings.block,
            times_stock=1 / slower[name],
        )
        for name, timing in timings.items()
    }


def _as_json(rates: Mapping[str, Rate]) -> dict[str, dict[str, Any]]:
    return {name: asdict(rate) for name, rate in rates.items()}


def _core_table(parts: Mapping[str, Mapping[str, Mapping[str, Rate]]]) -> str:
    lines = [
        "| domain | what | candidate | transitions/s | CPU ms per transition | times TorchRL | target |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {domain} | {what} | {name} | {rate.per_s:.1f} | {rate.cpu_ms:.2f} | {rate.times_stock:.2f} "
        f"| {TARGETS.get(name, '')} |"
        for what, domains in parts.items()
        for domain, rates in domains.items()
        for name, rate in rates.items()
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

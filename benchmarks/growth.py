"""How the cost of each stage grows with what a user may enlarge.

``python -m benchmarks.growth`` prints a table per section:

* ``domains``: a pre-training update with the cyclic datasets of 1 to 8 domains.
* ``batch``: a pre-training and a downstream update (dense features) at batches of 128 to 1024.
* ``prototypes``: a pre-training update and the exploration bonus with 128 to 4096 prototypes, the bonus's queue four
  times as long as there are prototypes, as in the paper.
* ``replay``: a downstream update and the memory it needs at 10,000 to 100,000 transitions, encoding anew and, where the
  library would choose them, with dense features.
* ``workers``: collection on the real simulator by 1 to 4 processes.

Candidates of one table take turns, except along ``replay`` and ``workers``, where only one fits at a time. Downstream
updates are means of two, because the actor learns in every second.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.candidates import Candidates, time_in_pairs
from benchmarks.collecting_workers import worker_rates, worker_table
from benchmarks.library_updates import (
    DownstreamUpdates,
    PretrainUpdates,
    dense_bytes,
    fresh_loss,
    fresh_pretrained,
    require_dense,
    synthetic_episodes,
)
from benchmarks.measure import ratios, save, side_by_side
from benchmarks.synthetic import write_dataset
from crptpro.cards import cpu_cores
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import CRPTproError
from crptpro.quality import Quality
from crptpro.transforms import PrototypeReward

Section = Literal["domains", "batch", "prototypes", "replay", "workers"]
SECTIONS: tuple[Section, ...] = ("domains", "batch", "prototypes", "replay", "workers")


@dataclass(frozen=True)
class Settings:
    """What to enlarge, how far, and how often to time it."""

    only: tuple[Section, ...] = SECTIONS
    """sections to run"""
    domains: tuple[int, ...] = (1, 2, 3, 4, 6, 8)
    """numbers of domains"""
    batch_sizes: tuple[int, ...] = (128, 256, 512, 1024)
    """transitions per update"""
    prototypes: tuple[int, ...] = (128, 256, 512, 1024, 2048, 4096)
    """numbers of prototypes"""
    replay_transitions: tuple[int, ...] = (10_000, 20_000, 40_000, 100_000)
    """transitions in the replay"""
    workers: tuple[int, ...] = (1, 2, 3, 4)
    """collecting processes"""
    rounds: int = 9
    """timed calls of each candidate, taken in turns"""
    warmup: int = 2
    """calls of each candidate before the first timed one"""
    threads: int = dataclasses.field(default_factory=cpu_cores)
    """of torch; all cores this process may use by default"""
    batch_size: int = 512
    """transitions per update where it is not what grows"""
    image_size: int = 84
    """height and width in pixels"""
    dataset_transitions: int = 2_000
    """of each synthetic dataset, and of the replay in the section `batch` (0.39 MB each in bf16)"""
    collected_domain: str = "cheetah"
    """of the section `workers`"""
    collected_transitions: int = 6_000
    """that each number of workers collects, best a multiple of all these numbers times an episode of 500"""
    quality: Quality = "exact"
    """of the collected images"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Run the chosen sections, print their tables and write the JSON; returns what it holds."""
    torch.set_num_threads(settings.threads)
    sections: dict[Section, Callable[[Settings, Path], dict[str, Any]]] = {
        "domains": by_domains,
        "batch": by_batch,
        "prototypes": by_prototypes,
        "replay": by_replay,
        "workers": by_workers,
    }
    results: dict[str, Any] = {}
    for name, section in sections.items():
        if name in settings.only:
            print(f"\n## {name}", flush=True)
            with tempfile.TemporaryDirectory() as scratch:
                results[name] = section(settings, Path(scratch))
    path = save("growth", settings, results, out=settings.out)
    print(f"\n{path}")
    return results


def by_domains(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Time pre-training updates that take the datasets of more and more domains in turn."""
    datasets = _datasets(settings, scratch, max(settings.domains))
    candidates = {
        str(count): _pretraining(settings, datasets[:count], settings.batch_size)
        for count in settings.domains
    }
    return _time(settings, candidates, "domains", "pre-training update")


def by_batch(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Time updates of both stages with larger and larger batches."""
    datasets = _datasets(settings, scratch, 1)
    pretraining = {str(size): _pretraining(settings, datasets, size) for size in settings.batch_sizes}
    results = {"pretrain": _time(settings, pretraining, "batch", "pre-training update")}
    del pretraining
    downstream = {}
    for size in settings.batch_sizes:
        config = _config(settings, settings.dataset_transitions, batch_size=size)
        downstream[str(size)] = _downstream(settings, config, scratch / str(size))
    results["downstream"] = _time(
        settings, downstream, "batch", "downstream update, dense features", in_pairs=True
    )
    return results


def by_prototypes(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Time the pre-training update and the bonus with more and more prototypes."""
    datasets = _datasets(settings, scratch, 1)
    pretraining, bonus = {}, {}
    for count in settings.prototypes:
        pretraining[str(count)] = _pretraining(settings, datasets, settings.batch_size, prototypes=count)
        pretrained = fresh_pretrained(image_size=settings.image_size, prototypes=count)
        assert pretrained.prototypes is not None
        features = torch.rand(settings.batch_size, pretrained.encoder.feature_dim)
        reward = PrototypeReward(pretrained.projector, pretrained.prototypes, queue_size=4 * count)
        bonus[str(count)] = functools.partial(reward.intrinsic_reward, features)
    results = {"pretrain": _time(settings, pretraining, "prototypes", "pre-training update")}
    results["bonus"] = _time(settings, bonus, "prototypes", "bonus, its projection in fp32")
    return results


def by_replay(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Time downstream updates, and say what they need, with larger and larger replays."""
    print("\n| transitions | features | ms per update | GiB of frames on disk | GiB of dense features |")
    print("|---|---|---|---|---|", flush=True)
    results: dict[str, Any] = {}
    for transitions in settings.replay_transitions:
        with tempfile.TemporaryDirectory(dir=scratch) as run_dir:
            results[str(transitions)] = _one_replay(settings, transitions, Path(run_dir))
    return results


def _one_replay(settings: Settings, transitions: int, run_dir: Path) -> dict[str, Any]:
    config = _config(settings, transitions)
    anew = dataclasses.replace(config, features="reencode")
    pretrained = fresh_pretrained(image_size=settings.image_size)
    units = {"encoding anew": _downstream(settings, anew, run_dir / "reencode")}
    found: dict[str, Any] = {"dense_gib": dense_bytes(pretrained, config) / 2**30}
    try:
        require_dense(pretrained, config)
    except CRPTproError as reason:
        found["no_dense"] = str(reason)
    else:
        units["dense"] = _downstream(settings, config, run_dir / "dense")
    found["frames_gib"] = sum(f.stat().st_size for f in (run_dir / "reencode").rglob("*.memmap")) / 2**30
    found["timings"] = time_in_pairs(units, rounds=settings.rounds, warmup=settings.warmup)
    for name, timing in found["timings"].items():
        dense = f"{found['dense_gib']:.1f}" if name == "dense" else "-"
        print(
            f"| {transitions:,} | {name} | {1e3 * timing.median_s:.1f} | {found['frames_gib']:.2f} | {dense} |",
            flush=True,
        )
    if "no_dense" in found:
        print(f"| {transitions:,} | dense | does not fit | | {found['dense_gib']:.1f} |", flush=True)
    return found


def by_workers(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Collect with more and more processes."""
    rates = worker_rates(
        settings.collected_domain, scratch, workers=settings.workers, transitions=settings.collected_transitions,
        rounds=1, quality=settings.quality,
    )  # fmt: skip
    print(f"\n{worker_table(rates)}")
    return {str(count): found for count, found in rates.items()}


def _datasets(settings: Settings, scratch: Path, count: int) -> list[FrameDataset]:
    size, transitions = settings.image_size, settings.dataset_transitions
    return [
        FrameDataset.open(
            write_dataset(scratch / f"synthetic_{i}", transitions=transitions, seed=i, image_size=size)
        )
        for i in range(count)
    ]


def _pretraining(
    settings: Settings, datasets: list[FrameDataset], batch_size: int, *, prototypes: int = 512
) -> PretrainUpdates:
    loss = fresh_loss(image_size=settings.image_size, prototypes=prototypes)
    return PretrainUpdates(loss, datasets, batch_size=batch_size, precision="auto")


def _config(settings: Settings, transitions: int, *, batch_size: int | None = None) -> DownstreamConfig:
    return DownstreamConfig(
        action_repeat=2, batch_size=batch_size or settings.batch_size, replay_capacity=transitions,
        random_agent_steps=1, features="dense",
    )  # fmt: skip


def _downstream(settings: Settings, config: DownstreamConfig, run_dir: Path) -> DownstreamUpdates:
    pretrained = fresh_pretrained(image_size=settings.image_size)
    episodes = synthetic_episodes(config.resolved_replay_capacity, settings.image_size)
    return DownstreamUpdates(pretrained, episodes, config=config, run_dir=run_dir)


def _time(
    settings: Settings, candidates: Candidates, grows: str, unit: str, *, in_pairs: bool = False
) -> dict[str, Any]:
    """Time candidates named by their size and print a table."""
    time_all = time_in_pairs if in_pairs else side_by_side
    timings = time_all(candidates, rounds=settings.rounds, warmup=settings.warmup)
    smallest = next(iter(timings))
    times = ratios(timings, to=smallest)
    print(f"\n| {grows} | ms per {unit} | times that of {smallest} |\n|---|---|---|")
    for name, timing in timings.items():
        print(f"| {name} | {1e3 * timing.median_s:.1f} | {times[name]:.2f} |", flush=True)
    return {"unit": unit, "timings": timings, "times": times}


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

"""Updates of both stages beside their plain implementation, a whole decision on the simulator, and a sustained run.

``python -m benchmarks.updates`` times, in one process and taking turns, medians:

* ``pretrain``: sampling, random shift and one whole update, at the paper's scale. Plain float32 (see
  :mod:`benchmarks.plain_pretrain`), ours in float32, and ours in bfloat16 where ``precision=auto`` picks it.
* ``downstream``: sampling, features, bonus and one whole update, averaged over two because the actor learns in every
  second. Plain float32 that encodes anew (:mod:`benchmarks.plain_downstream`), ours that encodes anew, and ours from
  dense features.
* ``agent-step``: render, store, encode, act and update on the real simulator, with a full replay of dense features.
* ``sustained``: ``pretrain(...)`` as it is, records and checkpoints included.

With ``--peer DIR`` a released agent is timed in the same turns (:mod:`benchmarks.peer`).
"""

from __future__ import annotations

import dataclasses
import logging
import statistics
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.agent_step import measure_agent_step
from benchmarks.candidates import downstream_candidates, pretrain_candidates, time_in_pairs
from benchmarks.library_updates import dense_bytes, fresh_loss, fresh_pretrained, precisions
from benchmarks.measure import Timing, ratios, save, side_by_side, table
from benchmarks.peer import Peer
from benchmarks.synthetic import write_dataset
from crptpro.cards import cpu_cores
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.domains import get_domain
from crptpro.downstream_config import DownstreamConfig
from crptpro.training import pretrain

logger = logging.getLogger("crptpro.benchmarks.updates")

Section = Literal["pretrain", "downstream", "agent-step", "sustained"]
SECTIONS: tuple[Section, ...] = ("pretrain", "downstream", "agent-step", "sustained")
PAPER_UPDATES = 50_000
PAPER_ENV_STEPS = 500_000


@dataclass(frozen=True)
class Settings:
    """What to time, at which size and how often."""

    only: tuple[Section, ...] = SECTIONS
    """sections to run"""
    rounds: int = 15
    """timed calls of each candidate, taken in turns; a call is one pre-training update or two downstream updates"""
    warmup: int = 2
    """calls of each candidate before the first timed one"""
    threads: int = dataclasses.field(default_factory=cpu_cores)
    """of torch; all cores this process may use by default"""
    batch_size: int = 512
    """transitions per update"""
    prototypes: int = 512
    """of the pre-training loss and of the bonus"""
    image_size: int = 84
    """height and width in pixels, of synthetic images and of the simulator's"""
    dataset: tuple[Path, ...] = ()
    """datasets to pre-train on, directories; synthetic ones by default"""
    domains: int = 3
    """synthetic datasets"""
    dataset_transitions: int = 10_000
    """of each synthetic dataset; also the most that the plain store holds in memory (127 KB each), from the first"""
    update_transitions: int = 4_000
    """replay of the section `downstream`: 127 KB each for the plain store, 0.39 MB in bf16 and 0.78 in fp32 for dense
    features"""
    replay_transitions: int = 40_000
    """replay of the section `agent-step`"""
    task: str = "cheetah_run"
    """of the section `agent-step`"""
    agent_steps: int = 500
    """decisions that the section `agent-step` times, at least four"""
    sustained_updates: int = 500
    """updates of the section `sustained`"""
    peer: Path | None = None
    """checkout of liuxin0824/CRPTpro or denisyarats/proto to time too, in the first two sections"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Run the chosen sections, print a table for each and write the JSON; returns what it holds."""
    torch.set_num_threads(settings.threads)
    peer = None
    if settings.peer is not None:
        peer = Peer(settings.peer, batch_size=settings.batch_size, prototypes=settings.prototypes)
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        datasets = (
            open_datasets(settings, Path(scratch)) if {"pretrain", "sustained"} & {*settings.only} else []
        )
        sections: dict[Section, Callable[[], dict[str, Any]]] = {
            "pretrain": lambda: time_pretraining(settings, datasets, peer),
            "downstream": lambda: time_downstream(settings, Path(scratch), peer),
            "agent-step": lambda: time_agent_step(settings, Path(scratch)),
            "sustained": lambda: time_sustained(settings, datasets, Path(scratch)),
        }
        for name, section in sections.items():
            if name in settings.only:
                print(f"\n## {name}\n", flush=True)
                results[name] = section()
                # At once: what has been measured must not be lost with a section for which memory is too small.
                print(f"\n{save('updates', settings, results, out=settings.out)}")
    return results


def open_datasets(settings: Settings, scratch: Path) -> list[FrameDataset]:
    """Open the datasets asked for, or write synthetic ones."""
    paths = list(settings.dataset)
    if not paths:
        logger.info(
            "writing %d synthetic datasets of %d transitions", settings.domains, settings.dataset_transitions
        )
        paths = [
            write_dataset(
                scratch / f"synthetic_{seed}", transitions=settings.dataset_transitions, seed=seed,
                image_size=settings.image_size,
            )
            for seed in range(settings.domains)
        ]  # fmt: skip
    return [FrameDataset.open(path) for path in paths]


def time_pretraining(settings: Settings, datasets: list[FrameDataset], peer: Peer | None) -> dict[str, Any]:
    """Time one pre-training update of every implementation."""
    candidates = pretrain_candidates(
        datasets,
        batch_size=settings.batch_size,
        image_size=settings.image_size,
        prototypes=settings.prototypes,
        plain_transitions=settings.dataset_transitions,
        peer=peer,
    )
    timings = side_by_side(candidates, rounds=settings.rounds, warmup=settings.warmup)
    return report(timings, unit="pre-training update")


def time_downstream(settings: Settings, scratch: Path, peer: Peer | None) -> dict[str, Any]:
    """Time one downstream update, the mean of two, of every implementation."""
    pretrained = fresh_pretrained(image_size=settings.image_size, prototypes=settings.prototypes)
    config = downstream_config(settings, settings.update_transitions)
    candidates = downstream_candidates(pretrained, config, scratch=scratch, peer=peer)
    timings = time_in_pairs(candidates, rounds=settings.rounds, warmup=settings.warmup)
    return report(timings, unit="downstream update")


def time_agent_step(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Time decisions on the real simulator."""
    pretrained = fresh_pretrained(image_size=settings.image_size, prototypes=settings.prototypes)
    config = downstream_config(settings, settings.replay_transitions)
    config = dataclasses.replace(config, action_repeat=get_domain(settings.task).action_repeat)
    gib = dense_bytes(pretrained, config) / 2**30
    print(
        f"{settings.task}, {settings.replay_transitions:,} transitions: dense features take {gib:.1f} GiB.\n"
    )
    found = measure_agent_step(
        settings.task, pretrained, config, scratch / "agent_step", agent_steps=settings.agent_steps
    )
    agent_steps = PAPER_ENV_STEPS // config.resolved_action_repeat
    for one in found:
        print(
            f"\nThe image is drawn {'while the update computes' if one.is_ahead else 'after the update'}.\n"
        )
        print(one.table())
        print(
            f"\n{PAPER_ENV_STEPS:,} env steps would take {one.hours(agent_steps):.1f} h, evaluations left out."
        )
    return {
        "ways": [{**dataclasses.asdict(one), "projected_hours": one.hours(agent_steps)} for one in found],
        "precision": precisions()[-1],
        "dense_gib": gib,
    }


def time_sustained(settings: Settings, datasets: list[FrameDataset], scratch: Path) -> dict[str, Any]:
    """Pre-train for a while as a user does and project the paper's number of updates."""
    loss = fresh_loss(image_size=settings.image_size, prototypes=settings.prototypes)
    interval = max(1, settings.sustained_updates // 10)
    result = pretrain(
        loss, datasets, updates=settings.sustained_updates, batch_size=settings.batch_size,
        run_dir=scratch / "sustained", log_interval=interval,
    )  # fmt: skip
    rates = [row["updates_per_s"] for row in result.history if "updates_per_s" in row]
    per_s = result.updates / result.seconds
    hours = PAPER_UPDATES / per_s / 3600
    print(
        "| updates | precision | updates/s | slowest to fastest tenth | hours for 50,000 |\n|---|---|---|---|---|"
    )
    print(
        f"| {result.updates} | {result.precision} | {per_s:.2f} | {min(rates):.2f} to {max(rates):.2f} | {hours:.2f} |"
    )
    return {
        "updates": result.updates,
        "seconds": result.seconds,
        "precision": result.precision,
        "updates_per_s": per_s,
        "updates_per_s_of_tenths": rates,
        "median_tenth_updates_per_s": statistics.median(rates),
        "projected_hours": hours,
    }


def downstream_config(settings: Settings, replay_transitions: int) -> DownstreamConfig:
    """Return the paper's settings at this benchmark's batch and replay."""
    return DownstreamConfig(
        env_steps=PAPER_ENV_STEPS, action_repeat=2, batch_size=settings.batch_size,
        replay_capacity=replay_transitions, random_agent_steps=1,
    )  # fmt: skip


def report(timings: Mapping[str, Timing], *, unit: str) -> dict[str, Any]:
    """Print times and ratios to the last candidate, which is the one a user gets; return them."""
    best = list(timings)[-1]
    print(f"One {unit}; times slower than '{best}'.\n")
    print(table(timings, to=best))
    return {"unit": unit, "timings": timings, "times_slower": ratios(timings, to=best), "than": best}


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

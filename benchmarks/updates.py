"""Updates of both stages beside their plain implementation, a whole decision on the simulator, and a sustained run.

``python -m benchmarks.updates`` times, in one process and taking turns, medians:

* ``pretrain``: sampling, random shift and one whole update. Plain float32 (:mod:`benchmarks.plain_pretrain`), ours in
  float32, and ours in bfloat16 where ``precision=auto`` picks it.
* ``downstream``: sampling, features, bonus and one whole update, the mean of two because the actor learns in every
  second. Plain float32 that encodes anew (:mod:`benchmarks.plain_downstream`), ours that encodes anew, ours from dense
  features.
* ``decision``: act, step, update and store on the real simulator, with a full replay of dense features.
* ``sustained``: ``pretrain(...)`` as it is, records and checkpoints included.
* ``parity``: bfloat16 against float32 over whole pre-trainings, beside what another seed changes.

With ``--peer DIR`` a released agent is timed in the same turns (:mod:`benchmarks.peer`).
"""

from __future__ import annotations

import itertools
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.library import Downstream, PretrainUpdates, fresh_loss, fresh_pretrained, precisions
from benchmarks.measure import report, save, side_by_side
from benchmarks.peer import Peer
from benchmarks.plain_downstream import PlainDownstream
from benchmarks.plain_pretrain import PlainPretraining, StackedStore
from benchmarks.synthetic import ACTION_DIM, make_drifting_env, write_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.modules import SquashedGaussianActor, TwinCritic
from crptpro.provenance import cpu_cores
from crptpro.training import DownstreamConfig, pretrain

Section = Literal["pretrain", "downstream", "decision", "sustained", "parity"]
PAPER_UPDATES, PAPER_ENV_STEPS = 50_000, 500_000
CURVES = ("loss_comp", "embedding_cosine")


@dataclass(frozen=True)
class Settings:
    """What to time, at which size and how often."""

    only: tuple[Section, ...] = ("pretrain", "downstream", "decision", "sustained")
    """sections to run"""
    rounds: int = 15
    """timed calls of each candidate, taken in turns; a call is one pre-training update or two downstream updates"""
    threads: int = field(default_factory=cpu_cores)
    """of torch; all cores this process may use by default"""
    batch_size: int = 512
    """transitions per update"""
    prototypes: int = 512
    """of the pre-training loss and of the bonus"""
    image_size: int = 84
    """height and width in pixels"""
    dataset: tuple[Path, ...] = ()
    """datasets to pre-train on, directories; three synthetic ones by default"""
    dataset_transitions: int = 10_000
    """of each synthetic dataset; also the most that the plain store holds in memory (127 KB each), from the first"""
    update_transitions: int = 2_000
    """replay of the section `downstream`: 0.4 MB each for dense features in bf16, 0.8 in fp32"""
    replay_transitions: int = 40_000
    """replay of the section `decision`"""
    task: str = "cheetah_run"
    """of the section `decision`"""
    decisions: int = 300
    """that the section `decision` times, an even number"""
    sustained_updates: int = 500
    """updates of the section `sustained`"""
    parity_updates: int = 200
    """updates of each pre-training of the section `parity`"""
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
    with tempfile.TemporaryDirectory(prefix="crptpro-updates-") as directory:
        scratch = Path(directory)
        datasets = list(settings.dataset)
        if not datasets and {"pretrain", "sustained", "parity"} & {*settings.only}:
            sizes = {"transitions": settings.dataset_transitions, "image_size": settings.image_size}
            datasets = [write_dataset(scratch / f"drifting_{seed}", seed=seed, **sizes) for seed in range(3)]
        sections: dict[Section, Callable[[], dict[str, Any]]] = {
            "pretrain": lambda: time_pretraining(settings, datasets, peer),
            "downstream": lambda: time_downstream(settings, scratch, peer),
            "decision": lambda: time_decisions(settings, scratch),
            "sustained": lambda: time_sustained(settings, datasets, scratch),
            "parity": lambda: compare_curves(settings, datasets),
        }
        for name in settings.only:
            print(f"\n## {name}\n", flush=True)
            results[name] = sections[name]()
            # At once: what has been measured must not be lost with a section for which memory is too small.
            save("updates", settings, results, out=settings.out)
    return results


def time_pretraining(settings: Settings, datasets: list[Path], peer: Peer | None) -> dict[str, Any]:
    """Time one pre-training update of every implementation."""
    batch, sizes = settings.batch_size, {"image_size": settings.image_size, "prototypes": settings.prototypes}
    store = StackedStore.of(FrameDataset.open(datasets[0]), settings.dataset_transitions)
    plain = PlainPretraining.like(fresh_loss(**sizes))
    candidates: dict[str, Callable[[], Any]] = {"plain fp32": lambda: plain.sample_and_update(store, batch)}
    if peer is not None:
        candidates["released agent"] = peer.pretrain_update(store)
    for precision in precisions():
        loss = fresh_loss(**sizes)
        candidates[f"ours {precision}"] = PretrainUpdates(
            loss, datasets, batch_size=batch, precision=precision
        )
    return report(side_by_side(candidates, rounds=settings.rounds), unit="pre-training update")


def time_downstream(settings: Settings, scratch: Path, peer: Peer | None) -> dict[str, Any]:
    """Time one downstream update, the mean of two, of every implementation."""
    batch, transitions = settings.batch_size, settings.update_transitions
    pretrained = fresh_pretrained(image_size=settings.image_size, prototypes=settings.prototypes)
    path = write_dataset(scratch / "plain", transitions=transitions, image_size=settings.image_size)
    store = StackedStore.of(FrameDataset.open(path), transitions)
    dim = pretrained.encoder.feature_dim
    plain = PlainDownstream.like(
        pretrained, SquashedGaussianActor(dim, ACTION_DIM), TwinCritic(dim, ACTION_DIM)
    )
    steps = itertools.count()
    candidates: dict[str, Callable[[], Any]] = {
        "plain fp32": lambda: plain.sample_and_update(store, batch, next(steps))
    }
    if peer is not None:
        candidates["released agent"] = peer.downstream_update(store)
    cases = [("reencode", "encoding anew", precision) for precision in precisions()]
    if len(cases) == 1:
        cases.append(("dense-bf16", "dense features in bf16", "fp32"))
    cases += [("dense", "dense features", precision) for precision in precisions()]
    for features, words, precision in cases:
        config = downstream_config(settings, transitions, features=features, precision=precision)
        ours = Downstream(pretrained, config, env_factory=make_drifting_env)
        ours.fill(transitions)
        candidates[f"ours {precision}, {words}"] = ours.update
    pairs = {name: _twice(call) for name, call in candidates.items()}
    return report(side_by_side(pairs, rounds=settings.rounds, per_call=2), unit="downstream update")


def time_decisions(settings: Settings, scratch: Path) -> dict[str, Any]:
    """Time decisions on the real simulator: the next image drawn after the update, then during it."""
    pretrained = fresh_pretrained(image_size=settings.image_size, prototypes=settings.prototypes)
    config = downstream_config(settings, settings.replay_transitions, features="auto")
    found: dict[str, dict[str, Any]] = {}
    for runs_ahead in (False, True):
        run = Downstream(
            pretrained, config, task=settings.task, run_dir=scratch / "decision", runs_ahead=runs_ahead
        )
        try:
            run.fill(settings.replay_transitions)
            for _ in range(20):
                run.decide()
            run.seconds.clear()
            pairs = settings.decisions // 2
            timed = side_by_side({"": _twice(run.decide)}, rounds=pairs, warmup=0, per_call=2)
        finally:
            run.close()
        hours = timed[""].median_s * PAPER_ENV_STEPS / (run.config.action_repeat or 1) / 3600
        found[f"drawn {'during' if runs_ahead else 'after'} the update"] = {
            "timing": timed[""],
            "mean_s_by_stage": {stage: seconds / (2 * pairs) for stage, seconds in run.seconds.items()},
            "projected_hours": hours,
        }
        del run  # its maps are dropped before the next ones are made
    print(f"One decision on {settings.task}, ms.\n\n| | {' | '.join(found)} |\n|---|---|---|")
    for stage in found["drawn after the update"]["mean_s_by_stage"]:
        print(_line(stage, [1e3 * way["mean_s_by_stage"].get(stage, 0.0) for way in found.values()]))
    print(_line("**whole**, median", [1e3 * way["timing"].median_s for way in found.values()]))
    print(_line("500,000 env steps, hours", [way["projected_hours"] for way in found.values()]))
    return found


def time_sustained(settings: Settings, datasets: list[Path], scratch: Path) -> dict[str, Any]:
    """Pre-train for a while as a user does and project the paper's number of updates."""
    loss = fresh_loss(image_size=settings.image_size, prototypes=settings.prototypes)
    result = pretrain(
        loss, datasets, updates=settings.sustained_updates, batch_size=settings.batch_size,
        run_dir=scratch / "sustained", log_interval=max(1, settings.sustained_updates // 10),
    )  # fmt: skip
    rates = [row["updates_per_s"] for row in result.history if "updates_per_s" in row]
    rate = statistics.median(rates)
    hours = PAPER_UPDATES / rate / 3600
    print("| updates | precision | updates/s, median tenth | slowest to fastest | hours for 50,000 |")
    print("|---|---|---|---|---|")
    precision = result.training["settings"]["precision"]
    spread = f"{min(rates):.2f} to {max(rates):.2f}"
    print(f"| {result.updates} | {precision} | {rate:.2f} | {spread} | {hours:.2f} |")
    return {
        "precision": precision, "updates_per_s": rate, "updates_per_s_of_tenths": rates, "projected_hours": hours,
    }  # fmt: skip


def compare_curves(settings: Settings, datasets: list[Path]) -> dict[str, Any]:
    """Pre-train in float32, in bfloat16 from the same seed, and in float32 from another; compare the curves."""
    curves: dict[str, dict[str, torch.Tensor]] = {}
    for name, precision, seed in (("fp32", "fp32", 0), ("bf16", "bf16", 0), ("other seed", "fp32", 1)):
        loss = fresh_loss(image_size=settings.image_size, prototypes=settings.prototypes, seed=seed)
        result = pretrain(
            loss, datasets, updates=settings.parity_updates, batch_size=settings.batch_size, seed=seed,
            precision=precision, log_interval=max(1, settings.parity_updates // 20),
        )  # fmt: skip
        curves[name] = {curve: torch.tensor([row[curve] for row in result.history]) for curve in CURVES}
    found: dict[str, Any] = {
        name: {c: v.tolist() for c, v in curve.items()} for name, curve in curves.items()
    }
    print("Mean absolute difference of two curves.\n")
    print("| curve | bf16 against fp32, same seed | fp32, two seeds |\n|---|---|---|")
    for curve in CURVES:
        near, far = ((curves[name][curve] - curves["fp32"][curve]).abs().mean() for name in list(curves)[1:])
        print(f"| {curve} | {near:.5f} | {far:.5f} |")
    return found


def downstream_config(settings: Settings, transitions: int, **options: Any) -> DownstreamConfig:
    """Return the paper's settings at this benchmark's batch and replay."""
    return DownstreamConfig(
        env_steps=PAPER_ENV_STEPS, batch_size=settings.batch_size, replay_capacity=transitions,
        random_agent_steps=1, **options,
    )  # fmt: skip


def _twice(call: Callable[[], Any]) -> Callable[[], None]:
    def both() -> None:
        call()
        call()

    return both


def _line(name: str, values: list[float]) -> str:
    return f"| {name} | {' | '.join(f'{value:.1f}' for value in values)} |"


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

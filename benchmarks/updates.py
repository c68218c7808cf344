"""Updates of both stages beside their plain implementation, a whole decision on the simulator, and a sustained run.

``python -m benchmarks.updates`` times, taking turns, medians:

* ``pretrain``: one update of ``pretrain(...)``, sampling and random shift included. Plain float32
  (:mod:`benchmarks.plain`), ours in float32, and ours in bfloat16 where ``precision=auto`` picks it.
* ``downstream``: sampling, features, bonus and one whole update of ``train_downstream(...)``, the mean of two because
  the actor learns in every second. Plain float32 that encodes anew, ours that encodes anew, ours from dense features.
* ``decision``: act, step, update and store on the real simulator, with a full replay of dense features.
* ``sustained``: ``pretrain(...)``, records and checkpoints included.
* ``parity``: bfloat16 against float32 over whole pre-trainings, beside what another seed changes.

With ``--peer DIR`` a released agent is timed in the same turns (:mod:`benchmarks.peer`).
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.loops import fresh_loss, fresh_pretrained
from benchmarks.measure import Loop, UpdateSettings, compare, run_sections
from benchmarks.peer import peer_update
from benchmarks.plain import Batch, PlainDownstream, PlainPretraining
from benchmarks.synthetic import ACTION_DIM, drifting_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.modules import SquashedGaussianActor, TwinCritic, resolve_precision
from crptpro.provenance import cpu_cores
from crptpro.training import pretrain

Section = Literal["pretrain", "downstream", "decision", "sustained", "parity"]
PAPER_UPDATES, PAPER_ENV_STEPS = 50_000, 500_000


@dataclass(frozen=True, kw_only=True)
class Settings(UpdateSettings):
    """What to time, at which size and how often."""

    only: tuple[Section, ...] = ("pretrain", "downstream", "decision", "sustained")
    """sections to run"""
    rounds: int = 15
    """timed calls of each candidate, taken in turns; a call is one pre-training update or two downstream updates"""
    threads: int = field(default_factory=cpu_cores)
    """of torch; all cores this process may use by default"""
    dataset: tuple[Path, ...] = ()
    """datasets to pre-train on, directories; three synthetic ones by default"""
    transitions: int = 2_000
    """of each synthetic dataset, of the plain store (127 KB each), and of the replay of the section `downstream`; dense
    features take 0.4 MB each in bf16, 0.8 in fp32"""
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

    @property
    def common(self) -> dict[str, Any]:
        """Settings of every loop that runs in its own process."""
        return {**self.sizes, "batch_size": self.batch_size, "threads": self.threads}


def main(settings: Settings) -> None:
    torch.set_num_threads(settings.threads)
    with tempfile.TemporaryDirectory(prefix="crptpro-updates-", dir=settings.scratch) as directory:
        scratch = Path(directory)
        sizes: dict[str, Any] = {"transitions": settings.transitions, "image_size": settings.image_size}
        datasets = [path.resolve() for path in settings.dataset] or [
            drifting_dataset(scratch, seed=seed, **sizes) for seed in range(3)
        ]
        sections: dict[Section, Callable[[], dict[str, Any]]] = {
            "pretrain": lambda: time_pretraining(settings, datasets),
            "downstream": lambda: time_downstream(settings, datasets[0]),
            "decision": lambda: time_decisions(settings, scratch),
            "sustained": lambda: time_sustained(settings, datasets, scratch),
            "parity": lambda: compare_curves(settings, datasets),
        }
        run_sections("updates", settings, sections)


def time_pretraining(settings: Settings, datasets: list[Path]) -> dict[str, Any]:
    store = Batch.of(FrameDataset.open(datasets[0]), settings.transitions)
    plain = PlainPretraining(fresh_loss(**settings.sizes))
    candidates: dict[str, Callable[[], Any]] = {"plain fp32": lambda: plain.update(store.sample(settings.batch_size))}
    if settings.peer is not None:
        theirs = peer_update(
            settings.peer, store, batch_size=settings.batch_size, prototypes=settings.prototypes, task_agnostic=True
        )
        candidates["released agent"] = lambda: theirs(2)  # even: all with an update frequency of 2 runs
    with ExitStack() as stack:
        for precision in precisions():
            candidates[f"ours {precision}"] = stack.enter_context(
                Loop("pretraining", datasets=datasets, precision=precision, **settings.common)
            )
        return compare(candidates, unit="pre-training update", rounds=settings.rounds)


def time_downstream(settings: Settings, dataset: Path) -> dict[str, Any]:
    pretrained = fresh_pretrained(**settings.sizes)
    store = Batch.of(FrameDataset.open(dataset), settings.transitions)
    sizes = pretrained.encoder.feature_dim, ACTION_DIM
    plain = PlainDownstream(pretrained, SquashedGaussianActor(*sizes), TwinCritic(*sizes))
    candidates: dict[str, Callable[[], Any]] = {
        "plain fp32": twice(lambda step: plain.update(store.sample(settings.batch_size), step))
    }
    if settings.peer is not None:
        theirs = peer_update(
            settings.peer, store, batch_size=settings.batch_size, prototypes=settings.prototypes, task_agnostic=False
        )
        candidates["released agent"] = twice(theirs)
    with ExitStack() as stack:
        for features, words in (("reencode", "encoding anew"), ("dense", "dense features")):
            for precision in precisions():
                candidates[f"ours {precision}, {words}"] = stack.enter_context(
                    Loop(
                        "downstream", of=("update",), transitions=settings.transitions, features=features,
                        precision=precision, **settings.common,
                    )
                )  # fmt: skip
        return compare(candidates, unit="downstream update", rounds=settings.rounds, per_call=2)


def time_decisions(settings: Settings, scratch: Path) -> dict[str, Any]:
    with Loop(
        "downstream", transitions=settings.replay_transitions, task=settings.task, features="dense",
        run_dir=scratch / "decision", **settings.common,
    ) as loop:  # fmt: skip
        pairs = [(loop(), loop.laps) for _ in range(10 + settings.decisions // 2)][10:]
    stages = {stage: statistics.median(laps[stage] for _, laps in pairs) for stage in pairs[0][1]}
    whole = statistics.median(seconds for seconds, _ in pairs)
    hours = whole * PAPER_ENV_STEPS / 2 / 3600
    print(f"| one decision on {settings.task} | median ms |\n|---|---|")
    for stage, seconds in {**stages, "**whole**": whole}.items():
        print(f"| {stage} | {1e3 * seconds:.1f} |")
    print(f"\n{PAPER_ENV_STEPS:,} env steps take {hours:.1f} h, evaluations left out.")
    return {"median_s_by_stage": stages, "median_s": whole, "projected_hours": hours}


def time_sustained(settings: Any, datasets: list[Path], scratch: Path, **options: Any) -> dict[str, Any]:
    result = pretrain(
        fresh_loss(**settings.sizes), datasets, updates=settings.sustained_updates, batch_size=settings.batch_size,
        run_dir=scratch / "sustained", log_interval=max(1, settings.sustained_updates // 10), **options,
    )  # fmt: skip
    rates = [row["updates_per_s"] for row in result.history if "updates_per_s" in row]
    rate, precision = statistics.median(rates), result.training["settings"]["precision"]
    hours = PAPER_UPDATES / rate / 3600
    print(
        f"{rate:.2f} updates/s in {precision}, tenths from {min(rates):.2f} to {max(rates):.2f}; "
        f"{PAPER_UPDATES:,} take {hours:.2f} h."
    )
    return {"precision": precision, "updates_per_s_of_tenths": rates, "projected_hours": hours}


def compare_curves(settings: Settings, datasets: list[Path]) -> dict[str, Any]:
    curves: dict[str, dict[str, list[float]]] = {}
    for name, precision, seed in (("fp32", "fp32", 0), ("bf16", "bf16", 0), ("other seed", "fp32", 1)):
        result = pretrain(
            fresh_loss(seed=seed, **settings.sizes), datasets, updates=settings.parity_updates, seed=seed,
            batch_size=settings.batch_size, precision=precision, log_interval=max(1, settings.parity_updates // 20),
        )  # fmt: skip
        curves[name] = {curve: [row[curve] for row in result.history] for curve in ("loss_comp", "embedding_cosine")}
    print("| mean absolute difference | bf16 against fp32, same seed | fp32, two seeds |\n|---|---|---|")
    for curve in curves["fp32"]:
        fp32, bf16, other = (torch.tensor(found[curve]) for found in curves.values())
        print(f"| {curve} | {(bf16 - fp32).abs().mean():.5f} | {(other - fp32).abs().mean():.5f} |")
    return curves


def precisions() -> list[str]:
    """Return fp32, the reference, and bf16 if that is what ``"auto"`` picks here."""
    return ["fp32"] if resolve_precision("auto", "cpu") == torch.float32 else ["fp32", "bf16"]


def twice(update: Callable[[int], Any]) -> Callable[[], None]:
    """Return a call that does an update with the actor's and one without."""

    def both() -> None:
        update(2)
        update(3)

    return both


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

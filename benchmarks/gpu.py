"""Everything that needs a CUDA device: parity of the fast ways, updates with every switch, where the time goes.

``python -m benchmarks.gpu`` prints, on synthetic frames held by the device:

* ``parity``: batches of the device against the CPU's, recorded and compiled updates against plain ones, both stages.
* ``pretrain``: one update, batches included: float32, TF32, bfloat16, recorded, compiled, both.
* ``sustained``: ``pretrain(...)`` as it is, and what 50,000 updates take; peak memory.
* ``downstream``: one update of the learner on features, with every switch, and what the 250,000 updates of 500,000 env
  steps take; simulator, encoding and evaluation left out.
* ``profile``: the kernels of recorded updates, beside the least arithmetic and traffic at the rates that one large
  product and one large copy reach on this device.

``--tiny`` runs all of it at a toy size, on the CPU where there is no GPU (nothing is recorded there).
"""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.gpu_checks import CAPTURED_TOLERANCE, COMPILED_TOLERANCE, check_batches, check_updates
from benchmarks.gpu_profile import profile_updates
from benchmarks.gpu_updates import DevicePretrainUpdates, DeviceSACUpdates, open_on
from benchmarks.library_updates import fresh_loss
from benchmarks.measure import Timing, ratios, save, side_by_side, table
from benchmarks.synthetic import write_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.training import pretrain

logger = logging.getLogger("crptpro.benchmarks.gpu")

Section = Literal["parity", "pretrain", "sustained", "downstream", "profile"]
SECTIONS: tuple[Section, ...] = ("parity", "pretrain", "sustained", "downstream", "profile")
PAPER_UPDATES = 50_000
PAPER_AGENT_STEPS = 250_000


@dataclass(frozen=True)
class Settings:
    """What to run, at which size and how often."""

    only: tuple[Section, ...] = SECTIONS
    """sections to run"""
    tiny: bool = False
    """a toy size that takes seconds, on the CPU if there is no GPU"""
    device: str = "cuda"
    """where to run"""
    rounds: int = 15
    """timed calls of each candidate, taken in turns"""
    updates_per_call: int = 20
    """updates between two looks at the clock"""
    batch_size: int = 512
    """transitions per update"""
    prototypes: int = 512
    """of the pre-training loss"""
    image_size: int = 84
    """height and width in pixels"""
    domains: int = 3
    """synthetic datasets"""
    transitions: int = 20_000
    """of each dataset, 21 KB each"""
    feature_dim: int = 39_200
    """of the downstream learner's input"""
    hidden_dim: int = 1024
    """of the downstream actor and critic"""
    parity_updates: int = 20
    """updates before weights are compared"""
    sustained_updates: int = 5_000
    """updates of the section `sustained`"""
    compile: bool = True
    """also the compiled candidates"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""

    def resolved(self) -> Settings:
        """Return the settings with what `tiny` changes."""
        if not self.tiny:
            return self
        return dataclasses.replace(
            self, device="cuda" if torch.cuda.is_available() else "cpu", rounds=1, updates_per_call=2, batch_size=8,
            prototypes=16, image_size=16, domains=2, transitions=40, feature_dim=40, hidden_dim=16, parity_updates=6,
            sustained_updates=8,
        )  # fmt: skip


def main(settings: Settings) -> dict[str, Any]:
    """Run the chosen sections, print their tables and write the JSON; returns what it holds.

    Raises:
        CRPTproError: without a CUDA device, or if a check of the section `parity` fails.
    """
    settings = settings.resolved()
    device = torch.device(settings.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise CRPTproError("No CUDA device here. `--tiny` runs through on the CPU.")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        paths = {
            f"domain_{number}": write_dataset(
                Path(scratch) / f"domain_{number}", transitions=settings.transitions, seed=number,
                image_size=settings.image_size,
            )
            for number in range(settings.domains)
        }  # fmt: skip
        datasets = open_on(paths, device)
        sections: dict[Section, Callable[[], Any]] = {
            "parity": lambda: check_parity(settings, datasets, open_on(paths, torch.device("cpu"))),
            "pretrain": lambda: time_pretraining(settings, datasets),
            "sustained": lambda: time_sustained(settings, datasets, Path(scratch)),
            "downstream": lambda: time_downstream(settings),
            "profile": lambda: profile_updates(
                _pretraining(settings, datasets, captures=True, compiles=settings.compile),
                tiny=settings.tiny,
            ),
        }
        for name in settings.only:
            print(f"\n## {name}\n")
            results[name] = sections[name]()
            if device.type == "cuda":
                torch.cuda.empty_cache()
    logger.info("written: %s", save("gpu", settings, results, out=settings.out))
    failed = [check["check"] for check in results.get("parity", []) if not check["passed"]]
    if failed:
        raise CRPTproError(f"Parity does not hold: {'; '.join(failed)}. Do not trust the times either.")
    return results


def check_parity(
    settings: Settings, datasets: dict[str, FrameDataset], on_cpu: dict[str, FrameDataset]
) -> list[dict[str, Any]]:
    """Run every check and print whether it passed."""
    pretraining = functools.partial(_pretraining, settings, datasets, precision="fp32")
    downstream = functools.partial(_downstream, settings, precision="fp32")
    checks = [check_batches(datasets, on_cpu, batch_size=settings.batch_size, captures=True)]
    for stage, make in (("pre-training", pretraining), ("downstream", downstream)):
        compare = functools.partial(check_updates, make=make, updates=settings.parity_updates)
        checks.append(compare(f"{stage}, recorded", tolerance=CAPTURED_TOLERANCE, captures=True))
        if settings.compile:
            name = f"{stage}, compiled and recorded"
            checks.append(compare(name, tolerance=COMPILED_TOLERANCE, captures=True, compiles=True))
    print("| check | largest weight difference | allowed | |\n|---|---|---|---|")
    for check in checks:
        difference = check.get("largest_weight_difference", 0.0)
        verdict = "ok" if check["passed"] else "**FAILED**"
        print(f"| {check['check']} | {difference:.1e} | {check.get('tolerance', 0.0):.0e} | {verdict} |")
    return checks


def time_pretraining(settings: Settings, datasets: dict[str, FrameDataset]) -> dict[str, Any]:
    """Time one pre-training update with every switch."""
    make = functools.partial(_pretraining, settings, datasets)
    candidates: dict[str, Callable[[], Any]] = {
        "fp32": make(precision="fp32"),
        "TF32": make(precision="fp32", tf32=True),
        "bf16": make(),
        "bf16, recorded": make(captures=True),
        "bf16, recorded, usual layout": make(captures=True, channels_last=False),
    }
    if settings.compile:
        candidates["bf16, compiled"] = make(compiles=True)
        candidates["bf16, compiled and recorded"] = make(compiles=True, captures=True)
    return _report(settings, candidates, count=PAPER_UPDATES, unit="pre-training update")


def time_downstream(settings: Settings) -> dict[str, Any]:
    """Time one update of the downstream learner with every switch."""
    make = functools.partial(_downstream, settings)
    candidates: dict[str, Callable[[], Any]] = {
        "fp32": make(precision="fp32"),
        "bf16": make(),
        "bf16, recorded": make(captures=True),
    }
    if settings.compile:
        candidates["bf16, compiled and recorded"] = make(compiles=True, captures=True)
    return _report(settings, candidates, count=PAPER_AGENT_STEPS, unit="downstream update")


def time_sustained(settings: Settings, datasets: dict[str, FrameDataset], scratch: Path) -> dict[str, Any]:
    """Pre-train for a while as a user does and project the paper's number of updates."""
    device = torch.device(settings.device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    loss = fresh_loss(image_size=settings.image_size, prototypes=settings.prototypes)
    result = pretrain(
        loss, datasets, updates=settings.sustained_updates, batch_size=settings.batch_size, device=device,
        run_dir=scratch / "sustained", log_interval=max(1, settings.sustained_updates // 10),
        compile="auto" if settings.compile else "off",
    )  # fmt: skip
    rates = sorted(row["updates_per_s"] for row in result.history if "updates_per_s" in row)
    steady = rates[len(rates) // 2]
    found = {
        "updates": result.updates,
        "seconds": result.seconds,
        "precision": result.precision,
        "compile": loss.training_record["compile"],
        "cuda_graph": loss.training_record["cuda_graph"],
        "median_updates_per_s": steady,
        "projected_s": PAPER_UPDATES / steady,
    }
    if device.type == "cuda":
        found["peak_allocated_bytes"] = torch.cuda.max_memory_allocated(device)
        found["peak_reserved_bytes"] = torch.cuda.max_memory_reserved(device)
    print(json.dumps(found, indent=1))
    return found


def _pretraining(
    settings: Settings, datasets: dict[str, FrameDataset], **switches: Any
) -> DevicePretrainUpdates:
    return DevicePretrainUpdates(
        datasets, batch_size=settings.batch_size, prototypes=settings.prototypes, **switches
    )


def _downstream(settings: Settings, **switches: Any) -> DeviceSACUpdates:
    return DeviceSACUpdates(
        feature_dim=settings.feature_dim, batch_size=settings.batch_size, hidden_dim=settings.hidden_dim,
        device=settings.device, **switches,
    )  # fmt: skip


def _report(
    settings: Settings, candidates: dict[str, Callable[[], Any]], *, count: int, unit: str
) -> dict[str, Any]:
    """Time candidates in turns, print milliseconds per update and what ``count`` of them take."""
    per_call = settings.updates_per_call

    def many(call: Callable[[], Any]) -> None:
        for _ in range(per_call):
            call()

    calls = {name: functools.partial(many, call) for name, call in candidates.items()}
    timed = side_by_side(calls, rounds=settings.rounds, warmup=2, device=settings.device)
    timings = {
        name: Timing(t.median_s / per_call, t.best_s / per_call, t.worst_s / per_call, t.rounds)
        for name, t in timed.items()
    }
    best = min(timings, key=lambda name: timings[name].median_s)
    print(f"One {unit}; times slower than '{best}'.\n\n{table(timings, to=best)}\n")
    projected = {name: count * t.median_s for name, t in timings.items()}
    print(f"{count:,} of '{best}' take {projected[best]:.0f} s.")
    return {
        "unit": unit,
        "timings": timings,
        "times_slower": ratios(timings, to=best),
        "projected_s": projected,
    }


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

"""Everything that needs a CUDA device: parity of the fast ways, updates with every switch, a sustained run.

``python -m benchmarks.gpu`` prints, on synthetic frames that the device holds:

* ``parity``: the device's samples and shifts against the CPU's; compiled and recorded updates against plain ones.
* ``pretrain``: one update, batches included: float32, TF32, bfloat16, compiled, recorded as a CUDA graph, both.
* ``downstream``: one update from dense features: float32, TF32, bfloat16, compiled.
* ``sustained``: ``pretrain(...)`` as it is, what 50,000 updates take, and its peak memory.

``--tiny`` runs all of it at a toy size, on the CPU where there is no GPU (nothing is recorded there).
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor, nn

from benchmarks.library import Downstream, PretrainUpdates, fresh_loss, fresh_pretrained
from benchmarks.measure import report, save, side_by_side
from benchmarks.synthetic import make_drifting_env, write_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.modules.precision import Precision
from crptpro.training import DownstreamConfig, pretrain
from crptpro.transforms import draw_offsets, random_shift

Section = Literal["parity", "pretrain", "downstream", "sustained"]
PAPER_UPDATES = 50_000
RECORDED_TOLERANCE, COMPILED_TOLERANCE = 1e-5, 1e-3
"""Largest difference allowed between float32 weights after some updates at learning rate 1e-4: Adam turns the rounding
of a gradient near zero into a step of the learning rate."""


@dataclass(frozen=True)
class Settings:
    """What to run, at which size and how often."""

    only: tuple[Section, ...] = ("parity", "pretrain", "downstream", "sustained")
    """sections to run"""
    tiny: bool = False
    """a toy size that takes seconds, on the CPU if there is no GPU"""
    compile: bool = True
    """also the compiled candidates"""
    rounds: int = 15
    """timed calls of each candidate, taken in turns"""
    updates_per_call: int = 20
    """updates between two looks at the clock"""
    batch_size: int = 512
    """transitions per update"""
    prototypes: int = 512
    """of loss and bonus"""
    image_size: int = 84
    """height and width in pixels"""
    transitions: int = 5_000
    """of each of three datasets, which every candidate holds on the device, 21 KB each, and of the replay"""
    parity_updates: int = 20
    """updates before weights are compared"""
    sustained_updates: int = 5_000
    """updates of the section `sustained`"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""

    def resolved(self) -> Settings:
        """Return the settings with what `tiny` changes."""
        sizes: dict[str, int] = {
            "rounds": 1, "updates_per_call": 2, "batch_size": 8, "prototypes": 16, "image_size": 16, "transitions": 40,
            "parity_updates": 6, "sustained_updates": 8,
        }  # fmt: skip
        return dataclasses.replace(self, **sizes) if self.tiny else self  # type: ignore[arg-type]


def main(settings: Settings) -> dict[str, Any]:
    """Run the chosen sections, print their tables and write the JSON; returns what it holds.

    Raises:
        CRPTproError: without a CUDA device, or if a check of the section `parity` fails.
    """
    settings = settings.resolved()
    if not (torch.cuda.is_available() or settings.tiny):
        raise CRPTproError("No CUDA device here. `--tiny` runs through on the CPU.")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-gpu-") as directory:
        sizes = {"transitions": settings.transitions, "image_size": settings.image_size}
        paths = [write_dataset(Path(directory) / f"drifting_{seed}", seed=seed, **sizes) for seed in range(3)]
        sections: dict[Section, Callable[[], Any]] = {
            "parity": lambda: check_parity(settings, paths, device),
            "pretrain": lambda: time_pretraining(settings, paths, device),
            "downstream": lambda: time_downstream(settings, device),
            "sustained": lambda: time_sustained(settings, paths, device, Path(directory)),
        }
        for name in settings.only:
            print(f"\n## {name}\n", flush=True)
            results[name] = sections[name]()
            if device.type == "cuda":
                torch.cuda.empty_cache()
            save("gpu", settings, results, out=settings.out)
    failed = [check["check"] for check in results.get("parity", []) if not check["passed"]]
    if failed:
        raise CRPTproError(f"Parity does not hold: {'; '.join(failed)}. Do not trust the times either.")
    return results


def check_parity(settings: Settings, paths: list[Path], device: torch.device) -> list[dict[str, Any]]:
    """Run every check and print whether it passed."""
    checks = [check_batches(paths[0], settings.batch_size, device)]
    records = device.type == "cuda"
    ways: list[tuple[str, float, dict[str, bool]]] = []
    if records:
        ways.append(("recorded", RECORDED_TOLERANCE, {"cuda_graph": True}))
    if settings.compile:
        ways.append(("compiled", COMPILED_TOLERANCE, {"compile": True}))
    if records and settings.compile:
        ways.append(("compiled and recorded", COMPILED_TOLERANCE, {"compile": True, "cuda_graph": True}))
    make_pretraining = functools.partial(pretraining, settings, paths, device, precision="fp32")
    make_downstream = functools.partial(downstream, settings, device, precision="fp32")
    for name, tolerance, switches in ways:
        fast = functools.partial(make_pretraining, **switches)
        checks.append(
            check_updates(f"pre-training, {name}", make_pretraining, fast, settings.parity_updates, tolerance)
        )
    if settings.compile:
        fast = functools.partial(make_downstream, compile=True)
        checks.append(
            check_updates(
                "downstream, compiled", make_downstream, fast, settings.parity_updates, COMPILED_TOLERANCE
            )
        )
    print("| check | largest difference | allowed | |\n|---|---|---|---|")
    for check in checks:
        verdict = "ok" if check["passed"] else "**FAILED**"
        print(f"| {check['check']} | {check['difference']:.1e} | {check['allowed']:.0e} | {verdict} |")
    return checks


def check_batches(path: Path, batch_size: int, device: torch.device) -> dict[str, Any]:
    """Compare a batch of the device, shifted there, with what the CPU makes of the same draws; must be equal."""
    generator = torch.Generator(device).manual_seed(0)
    batch = FrameDataset.open(path, device=device, generator=generator).sample(batch_size)
    expected = FrameDataset.open(path)[batch["index"].cpu()]
    difference = 0.0
    for key in ("pixels", ("next", "pixels")):
        offsets = draw_offsets(batch_size, 4)
        one, other = random_shift(batch[key], offsets).cpu(), random_shift(expected[key], offsets)
        difference = max(difference, float((one.int() - other.int()).abs().max()))
    name = "samples and shifts, against the CPU's"
    return {"check": name, "difference": difference, "allowed": 0.0, "passed": difference == 0}


Updates = tuple[Callable[[], Any], nn.Module]


def check_updates(
    name: str, plain: Callable[[], Updates], fast: Callable[[], Updates], updates: int, tolerance: float
) -> dict[str, Any]:
    """Compare weights after some updates with switches and without, from the same start on the same batches.

    A GPU may add up gradients in another order each time, so the plain updates are done twice: what differs by no more
    than three times as much as they do from themselves passes too.
    """
    made = [plain(), plain(), fast()]
    for _ in range(updates):
        for call, _loss in made:
            call()
    reference, again, other = (loss for _, loss in made)
    allowed = max(tolerance, 3 * largest_difference(reference, again))
    difference = largest_difference(reference, other)
    return {"check": name, "difference": difference, "allowed": allowed, "passed": difference <= allowed}


def largest_difference(one: nn.Module, two: nn.Module) -> float:
    """Return the largest difference of two modules' floating entries, targets included; NaN is infinite."""
    theirs = two.state_dict()
    return max(
        float((value.double() - theirs[key].double()).abs().max().nan_to_num(torch.inf))
        for key, value in one.state_dict().items()
        if isinstance(value, Tensor) and value.is_floating_point() and value.numel()
    )


def time_pretraining(settings: Settings, paths: list[Path], device: torch.device) -> dict[str, Any]:
    """Time one pre-training update with every switch."""
    make = functools.partial(pretraining, settings, paths, device)
    candidates = {
        "fp32": make(precision="fp32")[0],
        "TF32": in_tf32(make(precision="fp32")[0]),
        "bf16": make(precision="bf16")[0],
    }
    if device.type == "cuda":
        candidates["bf16, recorded"] = make(precision="bf16", cuda_graph=True)[0]
    if settings.compile:
        candidates["bf16, compiled"] = make(precision="bf16", compile=True)[0]
    if settings.compile and device.type == "cuda":
        candidates["bf16, compiled and recorded"] = make(precision="bf16", compile=True, cuda_graph=True)[0]
    return time_updates(settings, candidates, device, unit="pre-training update")


def time_downstream(settings: Settings, device: torch.device) -> dict[str, Any]:
    """Time one downstream update from dense features with every switch."""
    make = functools.partial(downstream, settings, device)
    candidates = {
        "fp32": make(precision="fp32")[0],
        "TF32": in_tf32(make(precision="fp32")[0]),
        "bf16": make(precision="bf16")[0],
    }
    if settings.compile:
        candidates["bf16, compiled"] = make(precision="bf16", compile=True)[0]
    return time_updates(settings, candidates, device, unit="downstream update")


def time_updates(
    settings: Settings, candidates: dict[str, Callable[[], Any]], device: torch.device, *, unit: str
) -> dict[str, Any]:
    """Time candidates in turns, many updates between two looks at the clock."""
    count = settings.updates_per_call

    def many(call: Callable[[], Any]) -> None:
        for _ in range(count):
            call()

    calls = {name: functools.partial(many, call) for name, call in candidates.items()}
    return report(side_by_side(calls, rounds=settings.rounds, per_call=count, device=device), unit=unit)


def time_sustained(
    settings: Settings, paths: list[Path], device: torch.device, scratch: Path
) -> dict[str, Any]:
    """Pre-train for a while as a user does and project the paper's number of updates."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    loss = fresh_loss(image_size=settings.image_size, prototypes=settings.prototypes)
    result = pretrain(
        loss, paths, updates=settings.sustained_updates, batch_size=settings.batch_size, device=str(device),
        run_dir=scratch / "sustained", log_interval=max(1, settings.sustained_updates // 10), compile=settings.compile,
        cuda_graph=device.type == "cuda",
    )  # fmt: skip
    rate = statistics.median(row["updates_per_s"] for row in result.history if "updates_per_s" in row)
    peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else 0
    print(
        f"{rate:.1f} updates/s; {PAPER_UPDATES:,} take {PAPER_UPDATES / rate:.0f} s; peak {peak / 2**30:.2f} GiB."
    )
    return {"updates_per_s": rate, "projected_s": PAPER_UPDATES / rate, "peak_allocated_bytes": peak}


def pretraining(settings: Settings, paths: list[Path], device: torch.device, **switches: Any) -> Updates:
    """Return pre-training updates and what they train."""
    loss = fresh_loss(image_size=settings.image_size, prototypes=settings.prototypes)
    return PretrainUpdates(loss, paths, batch_size=settings.batch_size, device=device, **switches), loss


def downstream(
    settings: Settings, device: torch.device, *, precision: Precision, compile: bool = False
) -> Updates:
    """Return downstream updates and what they train."""
    config = DownstreamConfig(
        env_steps=500_000, replay_capacity=settings.transitions, random_agent_steps=1, device=str(device),
        batch_size=settings.batch_size, features="dense", precision=precision, compile=compile,
    )  # fmt: skip
    pretrained = fresh_pretrained(image_size=settings.image_size, prototypes=settings.prototypes)
    run = Downstream(pretrained, config, env_factory=make_drifting_env)
    run.fill(settings.transitions)
    return run.update, run.learner.loss


def in_tf32(call: Callable[[], Any]) -> Callable[[], None]:
    """Let float32 factors be rounded to TF32 during a call."""

    def rounded() -> None:
        cudnn, matmul = torch.backends.cudnn, torch.backends.cuda.matmul
        before = cudnn.allow_tf32, matmul.allow_tf32
        cudnn.allow_tf32 = matmul.allow_tf32 = True
        try:
            call()
        finally:
            cudnn.allow_tf32, matmul.allow_tf32 = before

    return rounded


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

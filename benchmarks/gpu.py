"""Everything that needs a CUDA device: parity of the fast ways, updates with every switch, a sustained run.

``python -m benchmarks.gpu`` prints, on synthetic frames that the device holds:

* ``parity``: the device's samples and shifts against the CPU's; compiled and recorded updates against plain ones.
* ``pretrain``: one update of ``pretrain(...)``: float32, TF32, bfloat16, compiled, recorded as a CUDA graph, both.
* ``downstream``: one update of ``train_downstream(...)``, dense features: float32, TF32, bfloat16, compiled.
* ``sustained``: ``pretrain(...)`` with its log, what 50,000 updates take, and its peak memory.

``--tiny`` runs all of it at a toy size, on the CPU where there is no GPU (nothing is recorded there).
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor, nn

from benchmarks import updates
from benchmarks.loops import fresh_loss, fresh_pretrained
from benchmarks.measure import Loop, save, side_by_side, table
from benchmarks.synthetic import drifting_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.training import pretrain, train_downstream
from crptpro.transforms import draw_offsets, random_shift

Section = Literal["parity", "pretrain", "downstream", "sustained"]
Switches = dict[str, Any]
WAYS: dict[str, Switches] = {
    "recorded": {"cuda_graph": True},
    "compiled": {"compile": True},
    "compiled and recorded": {"compile": True, "cuda_graph": True},
}
"""Switches of a pre-training that are not to change what is computed."""
RECORDED_TOLERANCE, COMPILED_TOLERANCE = 1e-5, 1e-3
"""Largest difference allowed between float32 weights after some updates at learning rate 1e-4: Adam turns the rounding
of a gradient near zero into a step of the learning rate."""
TINY: dict[str, Any] = {
    "rounds": 1, "updates_per_call": 2, "batch_size": 8, "prototypes": 16, "image_size": 16, "transitions": 40,
    "parity_updates": 6, "sustained_updates": 8,
}  # fmt: skip


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

    @property
    def device(self) -> str:
        """The GPU, if there is one."""
        return "cuda" if torch.cuda.is_available() else "cpu"

    @property
    def sizes(self) -> dict[str, Any]:
        """What every network and image is sized by."""
        return {"image_size": self.image_size, "prototypes": self.prototypes}


def main(settings: Settings) -> dict[str, Any]:
    """Run the chosen sections, print their tables and write the JSON; returns what it holds.

    Raises:
        CRPTproError: without a CUDA device, or if a check of the section `parity` fails.
    """
    if settings.tiny:
        settings = dataclasses.replace(settings, **TINY)
    elif settings.device == "cpu":
        raise CRPTproError("No CUDA device here. `--tiny` runs through on the CPU.")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="crptpro-gpu-") as directory:
        sizes: dict[str, Any] = {"transitions": settings.transitions, "image_size": settings.image_size}
        paths = [drifting_dataset(directory, seed=seed, **sizes) for seed in range(3)]
        sections: dict[Section, Callable[[], Any]] = {
            "parity": lambda: check_parity(settings, paths),
            "pretrain": lambda: time_pretraining(settings, paths),
            "downstream": lambda: time_downstream(settings),
            "sustained": lambda: time_sustained(settings, paths, Path(directory)),
        }
        for name in settings.only:
            print(f"\n## {name}\n", flush=True)
            results[name] = sections[name]()
            if settings.device == "cuda":
                torch.cuda.empty_cache()
            save("gpu", settings, results, settings.out)
    if failed := [check["check"] for check in results.get("parity", []) if not check["passed"]]:
        raise CRPTproError(f"Parity does not hold: {'; '.join(failed)}. Do not trust the times either.")
    return results


def check_parity(settings: Settings, paths: list[Path]) -> list[dict[str, Any]]:
    """Run every check and print whether it passed."""
    pretrained = functools.partial(pretrained_weights, settings, paths)
    learned = functools.partial(learned_weights, settings)
    checks = [check_batches(settings, paths[0])]
    for name, switches in ways(settings).items():
        tolerance = COMPILED_TOLERANCE if "compile" in switches else RECORDED_TOLERANCE
        fast = functools.partial(pretrained, **switches)
        checks.append(check_weights(f"pre-training, {name}", pretrained, fast, tolerance))
    if settings.compile:
        fast = functools.partial(learned, compile=True)
        checks.append(check_weights("downstream, compiled", learned, fast, COMPILED_TOLERANCE))
    print("| check | largest difference | allowed | |\n|---|---|---|---|")
    for check in checks:
        verdict = "ok" if check["passed"] else "**FAILED**"
        print(f"| {check['check']} | {check['difference']:.1e} | {check['allowed']:.0e} | {verdict} |")
    return checks


def check_batches(settings: Settings, path: Path) -> dict[str, Any]:
    """Compare stacks and shifts of frames on the device with those on the CPU."""
    ours = FrameDataset.open(path, device=settings.device).sample(settings.batch_size)
    expected = FrameDataset.open(path)[ours["index"].cpu()]
    offsets = draw_offsets(settings.batch_size, 4)
    difference = 0
    for key in ("pixels", ("next", "pixels")):
        one, other = random_shift(ours[key], offsets).cpu(), random_shift(expected[key], offsets)
        difference = max(difference, int((one.int() - other.int()).abs().max()))
    name = "samples and shifts, against the CPU's"
    return {"check": name, "difference": difference, "allowed": 0, "passed": difference == 0}


def check_weights(
    name: str, plain: Callable[[], nn.Module], fast: Callable[[], nn.Module], tolerance: float
) -> dict[str, Any]:
    """Compare the weights of a training with switches and of one without, from the same start on the same batches.

    A GPU may add up gradients in another order each time, so the plain training is done twice: what differs by no more
    than three times as much as it does from itself passes too.
    """
    reference, again, other = plain(), plain(), fast()
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


def pretrained_weights(settings: Settings, paths: list[Path], **switches: Any) -> nn.Module:
    """Return the loss, with its networks and targets, after some updates in float32."""
    return pretrain(
        fresh_loss(**settings.sizes), paths, updates=settings.parity_updates, batch_size=settings.batch_size,
        device=settings.device, precision="fp32", progress=False, **switches,
    ).loss  # fmt: skip


def learned_weights(settings: Settings, **switches: Any) -> nn.Module:
    """Return the actor after some updates in float32; its losses are those of the critic."""
    torch.manual_seed(0)
    start = settings.batch_size
    return train_downstream(
        "drifting", fresh_pretrained(**settings.sizes), precision="fp32",
        env_steps=2 * (start + settings.parity_updates), random_agent_steps=start, batch_size=settings.batch_size,
        replay_capacity=2 * start + settings.parity_updates, features="dense", eval_episodes=1, eval_workers=0,
        eval_interval_env_steps=10**9, device=settings.device, progress=False, **switches,
    ).agent.actor  # fmt: skip


def time_pretraining(settings: Settings, paths: list[Path]) -> dict[str, Any]:
    """Time one pre-training update with every switch."""
    bf16 = {f"bf16, {name}": {"precision": "bf16", **switches} for name, switches in ways(settings).items()}
    return time_updates(settings, "pretraining", bf16, datasets=paths)


def time_downstream(settings: Settings) -> dict[str, Any]:
    """Time one downstream update from dense features with every switch."""
    compiled = {"bf16, compiled": {"precision": "bf16", "compile": True}} if settings.compile else {}
    return time_updates(settings, "downstream", compiled, transitions=settings.transitions, features="dense")


def time_updates(settings: Settings, item: str, more: dict[str, Switches], **common: Any) -> dict[str, Any]:
    """Time loops with switches in turns, many updates between two looks at the clock."""
    fp32, bf16 = {"precision": "fp32"}, {"precision": "bf16"}
    candidates: dict[str, Switches] = {"fp32": fp32, "TF32": {**fp32, "tf32": True}, "bf16": bf16, **more}
    common |= {"device": settings.device, "batch_size": settings.batch_size, **settings.sizes}
    common["passes"] = settings.updates_per_call
    with ExitStack() as stack:
        loops = {
            name: stack.enter_context(Loop(item, of=("update",), **common, **switches))
            for name, switches in candidates.items()
        }
        return table(side_by_side(loops, rounds=settings.rounds), unit=f"{item} update")


def time_sustained(settings: Settings, paths: list[Path], scratch: Path) -> dict[str, Any]:
    """Pre-train for a while as a user does, with every switch."""
    is_gpu = settings.device == "cuda"
    if is_gpu:
        torch.cuda.reset_peak_memory_stats()
    switches: Switches = {"device": settings.device, "compile": settings.compile, "cuda_graph": is_gpu}
    found = updates.time_sustained(settings, paths, scratch, **switches)
    peak = torch.cuda.max_memory_allocated() if is_gpu else 0
    print(f"Peak {peak / 2**30:.2f} GiB on the device.")
    return {**found, "peak_allocated_bytes": peak}


def ways(settings: Settings) -> dict[str, Switches]:
    """Return the ways that this machine has and the user wants."""
    missing = {"cuda_graph": settings.device == "cpu", "compile": not settings.compile}
    return {name: way for name, way in WAYS.items() if not any(missing[switch] for switch in way)}


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

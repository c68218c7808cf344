"""Everything that needs a CUDA device: parity of the fast paths, updates with every switch, a sustained run.

``python -m benchmarks.gpu`` prints, on synthetic frames that the device holds:

* ``parity``: the device's samples and shifts against the CPU's; compiled and recorded updates against plain ones.
* ``pretrain``: one update of ``pretrain(...)``: float32, bfloat16, compiled, recorded as a CUDA graph, both.
* ``downstream``: one update of ``train_downstream(...)``, dense features, with the same switches.
* ``sustained``: ``pretrain(...)`` with its log, what 50,000 updates take, and its peak memory.

``--tiny`` runs all of it at a toy size, on the CPU where there is no GPU (nothing is recorded there).
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor, nn

from benchmarks import updates
from benchmarks.loops import fresh_loss, fresh_pretrained
from benchmarks.measure import Loop, UpdateSettings, compare, run_sections
from benchmarks.synthetic import drifting_dataset
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.training import pretrain, train_downstream
from crptpro.transforms import draw_offsets, random_shift

Section = Literal["parity", "pretrain", "downstream", "sustained"]
Switches = dict[str, Any]
FP32, BF16 = {"precision": "fp32"}, {"precision": "bf16"}
RECORDED_TOLERANCE, COMPILED_TOLERANCE = 1e-5, 1e-3
"""Largest difference allowed between float32 weights after some updates at learning rate 1e-4: Adam turns the rounding
of a gradient near zero into a step of the learning rate."""
TINY: dict[str, Any] = {
    "rounds": 1, "updates_per_call": 2, "batch_size": 8, "prototypes": 16, "image_size": 16, "transitions": 40,
    "parity_updates": 6, "sustained_updates": 8,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Settings(UpdateSettings):
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
    """updates per timed call"""
    transitions: int = 5_000
    """of each of three datasets, which every candidate holds on the device, 21 KB each, and of the replay"""
    parity_updates: int = 20
    """updates before weights are compared"""
    sustained_updates: int = 5_000
    """updates of the section `sustained`"""

    @property
    def device(self) -> str:
        """The GPU, if there is one."""
        return "cuda" if torch.cuda.is_available() else "cpu"

    @property
    def ways(self) -> dict[str, Switches]:
        """Switches of a pre-training that this machine supports and that must not change what is computed."""
        found: dict[str, Switches] = {"recorded": {"cuda_graph": True}} if self.device == "cuda" else {}
        if self.compile:
            found["compiled"] = {"compile": True}
        if len(found) == 2:
            found["compiled and recorded"] = {"compile": True, "cuda_graph": True}
        return found


def main(settings: Settings) -> None:
    if settings.tiny:
        settings = dataclasses.replace(settings, **TINY)
    elif settings.device == "cpu":
        raise CRPTproError("No CUDA device here. `--tiny` runs through on the CPU.")
    with tempfile.TemporaryDirectory(prefix="crptpro-gpu-", dir=settings.scratch) as directory:
        sizes: dict[str, Any] = {"transitions": settings.transitions, "image_size": settings.image_size}
        # Domains have actions of their own, which must not keep an update from being recorded.
        paths = [drifting_dataset(directory, seed=seed, action_dim=6 + seed, **sizes) for seed in range(3)]
        bf16 = {f"bf16, {name}": {**BF16, **switches} for name, switches in settings.ways.items()}
        sections: dict[Section, Callable[[], Any]] = {
            "parity": lambda: check_parity(settings, paths),
            "pretrain": lambda: time_updates(settings, "pretraining", bf16, datasets=paths),
            "downstream": lambda: time_updates(
                settings, "downstream", bf16, transitions=settings.transitions, features="dense"
            ),
            "sustained": lambda: time_sustained(settings, paths, Path(directory)),
        }
        results = run_sections("gpu", settings, sections)
    if failed := [check["check"] for check in results.get("parity", []) if not check["passed"]]:
        raise CRPTproError(f"Parity does not hold: {'; '.join(failed)}. Do not trust the times either.")


def check_parity(settings: Settings, paths: list[Path]) -> list[dict[str, Any]]:
    common: dict[str, Any] = {**FP32, "batch_size": settings.batch_size, "device": settings.device, "progress": False}

    def pretrained(**switches: Any) -> nn.Module:
        loss = fresh_loss(**settings.sizes)
        return pretrain(loss, paths, updates=settings.parity_updates, **{**common, **switches}).loss

    def learned(**switches: Any) -> nn.Module:
        torch.manual_seed(0)
        start = settings.batch_size
        return train_downstream(
            "drifting", fresh_pretrained(**settings.sizes), env_steps=2 * (start + settings.parity_updates),
            random_agent_steps=start, replay_capacity=2 * start + settings.parity_updates, features="dense",
            eval_episodes=1, eval_workers=0, eval_interval_env_steps=10**9, **common, **switches,
        ).agent.actor  # fmt: skip

    checks = [check_batches(settings, paths[0])]
    for name, switches in settings.ways.items():
        checks.append(check_weights(f"pre-training, {name}", pretrained, **switches))
        checks.append(check_weights(f"pre-training in bf16, {name}", partial(pretrained, **BF16), **switches))
        checks.append(check_weights(f"downstream, {name}", learned, **switches))
    print("| check | largest difference | allowed | |\n|---|---|---|---|")
    for check in checks:
        verdict = "ok" if check["passed"] else "**FAILED**"
        print(f"| {check['check']} | {check['difference']:.1e} | {check['allowed']:.0e} | {verdict} |")
    torch.cuda.empty_cache()  # the other sections run in their own processes
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


def check_weights(name: str, train: Callable[..., nn.Module], **switches: bool) -> dict[str, Any]:
    """Compare the weights of a training with switches and of one without, from the same start on the same batches.

    A GPU may add up gradients in another order each time, so the plain training is done twice: a difference of up to
    three times that of its two runs passes too.
    """
    reference, again, fast = (entries(train(**some)) for some in ({}, {}, switches))
    tolerance = COMPILED_TOLERANCE if "compile" in switches else RECORDED_TOLERANCE
    allowed = max(tolerance, 3 * float((reference - again).abs().max()))
    difference = float((reference - fast).abs().max())
    return {"check": name, "difference": difference, "allowed": allowed, "passed": difference <= allowed}


def entries(module: nn.Module) -> Tensor:
    """Return all floating entries of a module, targets included, as one vector."""
    tensors = (value for value in module.state_dict().values() if isinstance(value, Tensor))
    return torch.cat([tensor.double().flatten() for tensor in tensors if tensor.is_floating_point()])


def time_updates(settings: Settings, item: str, more: dict[str, Switches], **common: Any) -> dict[str, Any]:
    """Time loops with switches in turns, many updates per timed call."""
    candidates: dict[str, Switches] = {"fp32": FP32, "bf16": BF16, **more}
    common |= {"device": settings.device, "batch_size": settings.batch_size, **settings.sizes}
    common["passes"] = settings.updates_per_call
    with ExitStack() as stack:
        loops = {
            name: stack.enter_context(Loop(item, of=("update",), **common, **switches))
            for name, switches in candidates.items()
        }
        return compare(loops, unit=f"{item} update", rounds=settings.rounds)


def time_sustained(settings: Settings, paths: list[Path], scratch: Path) -> dict[str, Any]:
    is_gpu = settings.device == "cuda"
    if is_gpu:
        torch.cuda.reset_peak_memory_stats()
    switches: Switches = {"device": settings.device, "compile": settings.compile, "cuda_graph": is_gpu}
    found = updates.time_sustained(settings, paths, scratch, **switches)
    peak = torch.cuda.max_memory_allocated() if is_gpu else 0
    print(f"Peak {peak / 2**30:.2f} GiB on the device.")
    return {**found, "peak_allocated_bytes": peak}


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

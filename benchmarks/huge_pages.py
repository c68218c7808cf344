"""What PyTorch's large tensors on huge pages save: the same updates in two processes, with them and without.

``python -m benchmarks.huge_pages`` lets two processes take turns, because PyTorch decides at its first tensor. Beside
the wall clock it reads the processor time that the system took, most of it to map and zero pages, and counts page
faults.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from torch.nn import functional as F
from tqdm.auto import tqdm

from benchmarks.library_updates import PretrainUpdates
from benchmarks.measure import save
from benchmarks.synthetic import write_dataset
from crptpro.cards import cpu_cores
from crptpro.console import run_main
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder, resolve_precision, set_compute_dtype
from crptpro.objectives import ATCLoss, BeCLLoss, ProtoLoss, method_defaults
from crptpro.training.pretrain.learner import Learner

METHODS = ("crptpro", "atc", "becl")
SWITCH = "THP_MEM_ALLOC_ENABLE"


@dataclass(frozen=True)
class Settings:
    """What to time, at which size and how often."""

    methods: tuple[str, ...] = METHODS
    """whose pre-training update; BeCL's is the encoder's, on one batch of random pictures"""
    rounds: int = 7
    """turns of each process"""
    updates: int = 3
    """updates in a turn"""
    batch_size: int = 512
    """transitions per update"""
    image_size: int = 84
    """height and width in pixels"""
    dataset_transitions: int = 2_000
    """of the synthetic dataset"""
    threads: int = field(default_factory=cpu_cores)
    """of torch"""
    out: Path | None = None
    """directory of the JSON; benchmarks/results by default"""


@dataclass(frozen=True)
class Cost:
    """One update, mean over a turn.

    Args:
        wall_s: seconds that passed.
        user_s: processor time in the program.
        system_s: processor time in the system.
        faults: pages mapped without a disk.
    """

    wall_s: float
    user_s: float
    system_s: float
    faults: float


def updates_of(method: str, settings: Settings, dataset: Path) -> Callable[[], object]:
    """Build one method's update."""
    torch.manual_seed(0)
    encoder = PixelEncoder(image_size=settings.image_size)
    if method != "becl":
        loss = (ProtoLoss if method == "crptpro" else ATCLoss)(encoder)
        return PretrainUpdates(
            loss, [FrameDataset.open(dataset)], batch_size=settings.batch_size, precision="auto"
        )
    loss = BeCLLoss(encoder)
    set_compute_dtype(loss.train(), resolve_precision("auto", "cpu"))
    defaults = method_defaults(loss)
    learner = Learner(
        loss, defaults, learning_rate=defaults.lr, encoder_tau=defaults.encoder_tau, updates=100
    )
    shape = (settings.batch_size, encoder.in_channels, settings.image_size, settings.image_size)
    pixels = torch.randint(0, 256, shape, dtype=torch.uint8)
    skill = F.one_hot(torch.arange(settings.batch_size) % 64, 64).float()
    batch = TensorDict({"next": {"pixels": pixels}, "skill": skill}, [settings.batch_size])
    return lambda: learner.update(batch, index=1, domain="drifting")


def serve(method: str, settings: Settings, dataset: Path) -> None:
    """Do a turn for every line on standard input and answer what it cost; the first warms up."""
    torch.set_num_threads(settings.threads)
    update = updates_of(method, settings, dataset)
    for _ in sys.stdin:
        before, start = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
        for _ in range(settings.updates):
            update()
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF)
        spent = (
            wall, after.ru_utime - before.ru_utime, after.ru_stime - before.ru_stime,
            after.ru_minflt - before.ru_minflt,
        )  # fmt: skip
        print(json.dumps([value / settings.updates for value in spent]), flush=True)


@contextmanager
def process(method: str, settings: Settings, dataset: Path, switch: str) -> Iterator[Callable[[], Cost]]:
    """Start a process with huge pages on ("1") or off ("0"); yields what does a turn in it."""
    request = json.dumps({**asdict(settings), "out": None})
    child = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.huge_pages", "--serve", method, request, str(dataset)],
        env={**os.environ, SWITCH: switch}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdin is not None
    assert child.stdout is not None
    to_child, from_child = child.stdin, child.stdout

    def turn() -> Cost:
        to_child.write("go\n")
        to_child.flush()
        if not (answer := from_child.readline()):
            raise CRPTproError(f"The updates of {method} failed with status {child.wait()}; see above.")
        return Cost(*json.loads(answer))

    try:
        yield turn
    finally:
        to_child.close()
        child.wait()


def compare(method: str, settings: Settings, dataset: Path) -> dict[str, Cost]:
    """Return the median cost of an update without huge pages and with them."""
    with (
        process(method, settings, dataset, "0") as plain,
        process(method, settings, dataset, "1") as huge,
    ):
        plain(), huge()  # to warm up
        turns = [
            (plain(), huge()) for _ in tqdm(range(settings.rounds), desc=method, leave=False, disable=None)
        ]
    medians = [
        Cost(
            *(statistics.median(values) for values in zip(*(asdict(c).values() for c in costs), strict=True))
        )
        for costs in zip(*turns, strict=True)
    ]
    return dict(zip(("without", "with"), medians, strict=True))


def main(settings: Settings) -> dict[str, Any]:
    """Compare, print the table and write the JSON; returns what it holds."""
    if unknown := set(settings.methods) - set(METHODS):
        raise CRPTproError(
            f"No updates of {', '.join(sorted(unknown))} here; choose from {', '.join(METHODS)}."
        )
    print("| one update of | huge pages | wall ms | program ms | system ms | page faults |")
    print("|---|---|---|---|---|---|")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        dataset = write_dataset(
            Path(scratch) / "drifting",
            transitions=settings.dataset_transitions,
            image_size=settings.image_size,
        )
        for method in settings.methods:
            costs = compare(method, settings, dataset)
            for name, cost in costs.items():
                times = " | ".join(f"{1e3 * s:,.0f}" for s in (cost.wall_s, cost.user_s, cost.system_s))
                print(f"| {method} | {name} | {times} | {cost.faults:,.0f} |", flush=True)
            results[method] = {name: asdict(cost) for name, cost in costs.items()}
    print(f"\n{save('huge_pages', settings, results, out=settings.out)}")
    return results


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(sys.argv[2], Settings(**json.loads(sys.argv[3])), Path(sys.argv[4]))
    else:
        run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

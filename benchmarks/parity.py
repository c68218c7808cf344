"""The fast arithmetic beside the reference over a run at the paper's size, in units of what another seed changes.

``python -m benchmarks.parity DATASET...`` trains three times on the same data: in float32, in bfloat16 from the same
seed, and in float32 from another. Where bfloat16 ends up is a matter of luck if its distance to float32 is larger than
that between two seeds; otherwise rounding matters less than which seed one happens to take.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor
from tyro.conf import Positional

from benchmarks.measure import save
from benchmarks.synthetic import write_dataset
from crptpro.console import run_main
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.training import pretrain

logger = logging.getLogger("crptpro.benchmarks.parity")

CURVES = ("loss_comp", "embedding_cosine")


@dataclass(frozen=True)
class Settings:
    """Which runs are compared."""

    datasets: Positional[tuple[Path, ...]] = ()
    """dataset directories; drifting pictures by default"""
    updates: int = 200
    """of each run"""
    batch_size: int = 512
    """transitions per update"""
    num_prototypes: int = 512
    """M"""
    interval: int = 10
    """updates that a point of a curve is the mean of"""
    fast: Literal["bf16", "compiled"] = "bf16"
    """what is compared with float32: bfloat16, or float32 compiled"""
    out: Path | None = None
    """directory of the results (default: benchmarks/results)"""


def curves(
    datasets: tuple[Path, ...], settings: Settings, *, seed: int, **switches: Any
) -> dict[str, Tensor]:
    """Train once and return the curves of the record, each ``[updates / interval]``.

    Args:
        datasets: their directories.
        settings: sizes.
        seed: of initialisation, sampling and shifts.
        **switches: of :func:`crptpro.training.pretrain`.
    """
    torch.manual_seed(seed)
    loss = ProtoLoss(PixelEncoder(), num_prototypes=settings.num_prototypes)
    start = time.perf_counter()
    result = pretrain(
        loss,
        list(datasets),
        updates=settings.updates,
        batch_size=settings.batch_size,
        seed=seed,
        log_interval=settings.interval,
        **switches,
    )
    seconds = time.perf_counter() - start
    logger.info("%s, seed %d: %.2f s per update", switches, seed, seconds / settings.updates)
    return {name: torch.tensor([row[name] for row in result.history]) for name in CURVES}


def distances(first: dict[str, Tensor], second: dict[str, Tensor]) -> dict[str, float]:
    """Mean absolute difference of each curve."""
    return {name: float((first[name] - second[name]).abs().mean()) for name in CURVES}


def measure(settings: Settings) -> dict[str, Any]:
    """Run all three and compare them."""
    switches = {"precision": "bf16"} if settings.fast == "bf16" else {"precision": "fp32", "compile": "on"}
    with tempfile.TemporaryDirectory(prefix="crptpro-parity-") as folder:
        datasets = settings.datasets
        if not datasets:
            datasets = (write_dataset(Path(folder) / "drifting", transitions=2_000),)
        reference = curves(datasets, settings, seed=0, precision="fp32")
        fast = curves(datasets, settings, seed=0, **switches)
        other = curves(datasets, settings, seed=1, precision="fp32")
    return {
        "fast against fp32, same seed": distances(fast, reference),
        "fp32, two seeds": distances(other, reference),
        "curves": {
            name: {
                "fp32": reference[name].tolist(),
                "fast": fast[name].tolist(),
                "other seed": other[name].tolist(),
            }
            for name in CURVES
        },
    }


def main(settings: Settings) -> None:
    """Measure, print, save; exit status 1 where the fast path leaves the spread of two seeds."""
    results = measure(settings)
    near, far = results["fast against fp32, same seed"], results["fp32, two seeds"]
    print(f"| curve | {settings.fast} against fp32, same seed | fp32, two seeds |")
    print("|---|---|---|")
    for name in CURVES:
        print(f"| {name} | {near[name]:.5f} | {far[name]:.5f} |")
    print(save("parity", settings, results, out=settings.out))
    if near["loss_comp"] > far["loss_comp"]:
        print(f"{settings.fast} is farther from fp32 than another seed is.")
        sys.exit(1)


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

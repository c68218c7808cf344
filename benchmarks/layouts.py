"""The encoder in both memory layouts, and with ReLU in a pass of its own: forward alone, and forward and backward.

``python -m benchmarks.layouts`` needs neither simulator nor data. It is what the switch ``channels_last`` decides with
``"auto"``; the rest of an update does not know the layout.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import tyro

from benchmarks.library_updates import precisions
from benchmarks.measure import save, side_by_side, table
from crptpro.console import run_main
from crptpro.modules import (
    PixelEncoder,
    convolutions,
    resolve_precision,
    set_channels_last,
    set_compute_dtype,
    usable_device,
)

WAYS = {"channels last": True, "usual": False, "channels last, ReLU apart": True}


@dataclass(frozen=True)
class Settings:
    """What to measure and how often."""

    batch_size: int = 512
    """observations"""
    image_size: int = 84
    """height and width in pixels"""
    rounds: int = 9
    """timed calls of each candidate, taken in turns"""
    device: str = "cpu"
    """where to compute"""
    out: Path | None = None
    """directory of the JSON file; benchmarks/results by default"""


def main(settings: Settings) -> dict[str, Any]:
    """Measure, print the tables, write the JSON, and return what it holds."""
    device = usable_device(settings.device)
    print(f"`python -m benchmarks.layouts {' '.join(sys.argv[1:])}`")
    generator = torch.Generator().manual_seed(0)
    shape = (settings.batch_size, 9, settings.image_size, settings.image_size)
    pixels = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator).to(device)
    results: dict[str, Any] = {}
    for precision in precisions(device):
        for work, call in (("forward", encode), ("forward and backward", differentiate)):
            candidates: dict[str, Callable[[], None]] = {}
            for way, is_last in WAYS.items():
                encoder = set_channels_last(PixelEncoder(image_size=settings.image_size).to(device), is_last)
                set_compute_dtype(encoder, resolve_precision(precision, device))
                one = functools.partial(call, encoder, pixels)
                candidates[way] = functools.partial(relu_apart, one) if way.endswith("apart") else one
            timings = side_by_side(candidates, rounds=settings.rounds, device=device)
            results[f"{precision}, {work}"] = timings
            print(
                f"\n{precision}, {work}, batch {settings.batch_size}\n\n{table(timings, to='channels last')}"
            )
    save("layouts", settings, results, out=settings.out)
    return results


@torch.no_grad()
def encode(encoder: PixelEncoder, pixels: torch.Tensor) -> None:
    """Encode a batch, as targets and frozen encoders do."""
    encoder(pixels)


def differentiate(encoder: PixelEncoder, pixels: torch.Tensor) -> None:
    """Encode a batch and go back to the weights, as training does."""
    encoder.zero_grad(set_to_none=True)
    features = encoder(pixels)
    features.backward(torch.ones_like(features))


def relu_apart(call: Callable[[], None]) -> None:
    """Call with every ReLU as an operation of its own, as it always is in fp32 and on a GPU."""
    with mock.patch.object(convolutions, "_can_fuse", return_value=False):
        call()


if __name__ == "__main__":
    run_main(lambda: main(tyro.cli(Settings, description=__doc__)))

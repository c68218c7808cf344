"""Do the fast ways compute what the plain ones do? Run by ``benchmarks.gpu`` before it times anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.gpu_updates import DevicePretrainUpdates, DeviceSACUpdates
from crptpro.data import FrameDataset
from crptpro.data.frame_stacks import stack_rows
from crptpro.transforms.random_shift import shifted_stacks

#: Batches of every domain: warm-up, recording and replays.
ROUNDS = 6

#: Largest difference allowed between weights after some updates at learning rate 1e-4 in float32: Adam turns the
#: rounding of a gradient near zero into a step of the learning rate.
CAPTURED_TOLERANCE = 1e-5
COMPILED_TOLERANCE = 1e-3


def check_batches(
    datasets: Mapping[str, FrameDataset],
    cpu_datasets: Mapping[str, FrameDataset],
    *,
    batch_size: int,
    captures: bool,
) -> dict[str, Any]:
    """Compare batches of the device with those that the CPU makes of the same draws; must be equal."""
    updates = DevicePretrainUpdates(
        datasets, batch_size=batch_size, prototypes=8, precision="fp32", captures=captures
    )
    batches, equal = updates.batches, True
    for _ in range(ROUNDS):
        for domain, dataset in cpu_datasets.items():
            batch = batches.sample(domain).cpu()
            draws = batches.draws.cpu()
            columns = dataset.transitions[draws.get("index")]
            for number, (key, ahead) in enumerate((("pixels", 0), (("next", "pixels"), 1))):
                row, step = columns.get("row") + ahead, columns.get("step") + ahead
                rows = stack_rows(row, step, dataset.frame_stack)
                frames = dataset.frames.get("pixels")
                expected = shifted_stacks(frames, rows, draws.get(f"offsets_{number}"), pad=batches.pad)
                equal &= torch.equal(batch.get(key), expected)
    return {"check": "batches of the device, against the CPU's", "rounds": ROUNDS, "passed": equal}


def check_updates(
    name: str,
    make: Callable[..., DevicePretrainUpdates | DeviceSACUpdates],
    *,
    updates: int,
    tolerance: float,
    **switches: bool,
) -> dict[str, Any]:
    """Compare weights after some updates with switches and without, from the same start on the same batches.

    A GPU may add up gradients in another order each time, so the plain updates are done twice: what differs by no more
    than three times as much as they do from themselves passes too.

    Args:
        name: of what is compared.
        make: builds the updates, given the switches.
        updates: how many.
        tolerance: largest difference of a weight.
        **switches: ``compiles`` and ``captures``.
    """
    plain, again, fast = make(), make(), make(**switches)
    for _ in range(updates):
        for update in (plain, again, fast):
            update()
    worst = largest_difference(plain.loss, fast.loss)
    spread = largest_difference(plain.loss, again.loss)
    return {
        "check": name,
        "updates": updates,
        "largest_weight_difference": worst,
        "spread_of_plain": spread,
        "tolerance": max(tolerance, 3 * spread),
        "passed": worst <= max(tolerance, 3 * spread),
    }


def largest_difference(one: nn.Module, two: nn.Module) -> float:
    """Return the largest difference of two modules' floating entries, targets included; NaN is infinite."""
    theirs = two.state_dict()
    differences = [
        float((value.double() - theirs[key].double()).abs().max().nan_to_num(torch.inf))
        for key, value in one.state_dict().items()
        if isinstance(value, Tensor) and value.is_floating_point() and value.numel()
    ]
    return max(differences)

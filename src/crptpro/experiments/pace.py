"""How fast networks are on this machine, beside the one that costs were measured on: a few updates by the clock."""

from __future__ import annotations

import time

import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from crptpro.experiments.piece_costs import ENCODER_ROW_S
from crptpro.modules import PixelEncoder, resolve_channels_last, resolve_precision
from crptpro.modules.numerics import computing
from crptpro.objectives import ProtoLoss
from crptpro.seeding import kept_global_rng

ROWS = 32
"""Of the timed batch: enough for the convolutions to weigh what they weigh in a whole one."""
TIMED = 3
"""Updates of which the fastest counts; one before them is not timed."""


def network_pace(threads: int) -> float:
    """Time updates of an encoder on random images, as a job on this CPU would compute them.

    Takes half a second to three seconds. What counts is processor time, so that a busy machine does not look like a
    slow one. The callers' random numbers are left alone.

    Args:
        threads: of torch in each job.

    Returns:
        Seconds of an update's row by those of one core of the reference machine; above 1 on a slower one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with kept_global_rng():
            loss = ProtoLoss(PixelEncoder())
            SoftUpdate(loss, tau=0.05)  # the loss warns if nobody moves its targets
            pixels = torch.randint(0, 256, (ROWS, 9, 84, 84), dtype=torch.uint8)
        batch = TensorDict({"pixels": pixels, "next": {"pixels": pixels}}, [ROWS])
        precision = resolve_precision("auto", "cpu")
        with computing(loss, precision, channels_last=resolve_channels_last("auto")):
            seconds = [_processor_seconds(loss, batch) for _ in range(1 + TIMED)]
    finally:
        torch.set_num_threads(before)
    return min(seconds[1:]) / threads / (ROWS * ENCODER_ROW_S)


def _processor_seconds(loss: ProtoLoss, batch: TensorDict) -> float:
    """Processor time of an update on all threads, of which none is idle in it for long."""
    start = time.process_time()
    out = loss.before_update()(batch)
    (out["loss_comp"] + out["loss_intr"]).backward()
    return time.process_time() - start

"""The fast arithmetic against the reference over a whole little run, in units of what another seed changes."""

from __future__ import annotations

from typing import Any

import torch
from pretrain_world import SETTINGS, make_datasets, make_loss

from crptpro.training import pretrain

UPDATES, INTERVAL = 200, 10


def curve(precision: str, seed: int) -> torch.Tensor:
    """The comparative loss of a run, means over ten updates."""
    settings: dict[str, Any] = {**SETTINGS, "batch_size": 16, "log_interval": INTERVAL}
    settings |= {"precision": precision, "seed": seed}
    result = pretrain(make_loss(seed), make_datasets(), updates=UPDATES, **settings)
    return torch.tensor([row["loss_comp"] for row in result.history])


def distance(first: torch.Tensor, second: torch.Tensor) -> float:
    return float((first - second).abs().mean())


def test_bf16_stays_within_the_spread_of_two_fp32_seeds_for_200_updates() -> None:
    reference, other_seed, fast = curve("fp32", 0), curve("fp32", 1), curve("bf16", 0)
    assert len(reference) == UPDATES // INTERVAL
    assert reference[-1] < reference[0] - 0.05  # it learns, so there is something to differ in
    assert 0 < distance(fast, reference) < 0.1 * distance(other_seed, reference)

"""What reinforcement-learning losses do with rows that a mask excludes."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from crptpro.objectives.base import valid_rows
from crptpro.objectives.functional import reduce_batch


def without_masked_values(loss: LossModule, tensordict: TensorDictBase) -> TensorDictBase:
    """Put zeros into masked rows: a NaN there would survive a zero weight in the backward.

    Args:
        loss: its ``in_keys`` are what is cleaned.
        tensordict: its input, left as it is.

    Returns:
        The input itself if it has no mask, otherwise a shallow copy with the entries replaced.
    """
    valid = valid_rows(loss, tensordict)
    if valid is None:
        return tensordict
    clean = tensordict.copy()
    for key in loss.in_keys:
        value = tensordict.get(key, None)
        if value is not None:
            flat = value.reshape(valid.shape[0], -1)
            flat = torch.where(valid.unsqueeze(-1), flat, torch.zeros_like(flat))
            clean.set(key, flat.reshape(value.shape))
    return clean


def mean_of_rows(values: Tensor, valid: Tensor | None) -> Tensor:
    """Mean over the rows that count, of any batch shape.

    Args:
        values: one per row.
        valid: flat bool over all rows, or None for all.
    """
    return reduce_batch(values.reshape(-1), "mean", valid)

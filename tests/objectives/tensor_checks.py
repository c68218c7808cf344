"""Tensors and comparisons that the tests of the mathematics share."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def double(rows: list) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def unit(*shape: int, seed: int = 0) -> Tensor:
    values = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return F.normalize(values, dim=-1)


def close(actual: Tensor, expected: Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance)

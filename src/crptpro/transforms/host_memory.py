"""CPU memory for large per-sample copies: blocks on huge pages, and tensors seen as plain numpy bits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

# numpy has no bfloat16; copying never looks at the values, so any type of the same width serves.
_STAND_IN = {torch.bfloat16: torch.int16}


def empty_on_huge_pages(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Allocate an uninitialised CPU tensor, on huge pages where the system grants them.

    torch maps every block above 32 MB freshly with 4 KiB pages, and faulting in the 40 MB of one feature
    batch then costs four times the copy itself. numpy asks Linux for huge pages on large blocks.

    Args:
        shape: shape of the tensor.
        dtype: any dtype that torch can place on the CPU.

    Returns:
        An uninitialised contiguous tensor.
    """
    memory = np.empty(math.prod(shape) * dtype.itemsize, dtype=np.uint8)
    return torch.from_numpy(memory).view(dtype).view(*shape)


def as_numpy_bits(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return a numpy array over the same memory, good for copying but not for arithmetic."""
    stand_in = _STAND_IN.get(tensor.dtype)
    return (tensor if stand_in is None else tensor.view(stand_in)).numpy()

"""CPU memory for large copies: blocks on huge pages, used again, and tensors seen as plain numpy bits."""

from __future__ import annotations

import contextlib
import math
import mmap
import sys
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

# numpy has no bfloat16; copying never looks at the values, so any type of the same width serves.
_STAND_IN = {torch.bfloat16: torch.int16}

SMALLEST_BLOCK = 2**23
"""Bytes below which the C library keeps and reuses what is freed."""

KEPT_BLOCKS = 16
"""Blocks that are remembered: two images, each with a second view, and the features of all, of two batches."""

KEPT_BYTES = 2**29
"""Size of all of them: a single large sample must not hold its memory for ever."""


class BlockPool:
    """Memory of batches that are gone, given to the next ones.

    The C library returns large blocks to the system when they are freed. Having each page mapped and zeroed again
    for every batch takes longer than filling it, and several times longer where memory is too fragmented for huge
    pages.

    A block is free again when no tensor refers to it any more, however many views there were: a tensor made by
    ``torch.frombuffer`` holds a reference to its block as long as anything shares its memory. What is seen is
    CPython's reference count; a count that is too high costs a new block and nothing else.

    Args:
        kept: blocks to remember; the longest remembered is forgotten first, and freed with its last tensor.
        kept_bytes: size of all that are remembered.
    """

    def __init__(self, kept: int = KEPT_BLOCKS, kept_bytes: int = KEPT_BYTES) -> None:
        self.kept, self.kept_bytes = kept, kept_bytes
        self._blocks: list[mmap.mmap] = []
        self._lock = threading.Lock()

    def take(self, size: int) -> mmap.mmap:
        """Return a block of ``size`` bytes that nothing else uses; its content is arbitrary."""
        with self._lock:
            for index in range(len(self._blocks)):
                if len(self._blocks[index]) == size and _references(self._blocks, index) == _NO_OTHERS:
                    block = self._blocks.pop(index)
                    break
            else:
                block = _map_block(size)
            self._blocks.append(block)
            del self._blocks[: -self.kept]
            while sum(map(len, self._blocks)) > self.kept_bytes:
                del self._blocks[0]
            return block


def _references(blocks: list[mmap.mmap], index: int) -> int:
    return sys.getrefcount(blocks[index])


# What the interpreter itself holds while it counts differs between its versions.
_NO_OTHERS = _references([mmap.mmap(-1, mmap.PAGESIZE)], 0)


def _map_block(size: int) -> mmap.mmap:
    block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):  # a kernel without huge pages: slower, not wrong
            block.madvise(mmap.MADV_HUGEPAGE)
    return block


_POOL = BlockPool()


def empty_batch(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Allocate an uninitialised CPU tensor for one batch; a large one uses memory of batches that are gone.

    Args:
        shape: shape of the tensor.
        dtype: any dtype that torch can place on the CPU.

    Returns:
        An uninitialised contiguous tensor.
    """
    size = math.prod(shape) * dtype.itemsize
    if size < SMALLEST_BLOCK:
        return torch.empty(shape, dtype=dtype, device="cpu")
    return torch.frombuffer(_POOL.take(size), dtype=dtype).view(*shape)


def empty_on_huge_pages(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Allocate an uninitialised CPU tensor that stays, on huge pages where the system grants them.

    Args:
        shape: shape of the tensor.
        dtype: any dtype that torch can place on the CPU.

    Returns:
        An uninitialised contiguous tensor.
    """
    memory = np.empty(math.prod(shape) * dtype.itemsize, dtype=np.uint8)  # numpy asks Linux for huge pages
    return torch.from_numpy(memory).view(dtype).view(*shape)


def as_numpy_bits(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return a numpy array over the same memory, good for copying but not for arithmetic."""
    stand_in = _STAND_IN.get(tensor.dtype)
    return (tensor if stand_in is None else tensor.view(stand_in)).numpy()

"""Frame stacks rebuilt from single frames: equal to a live stack, never reaching into another episode."""

from __future__ import annotations

import mmap
from pathlib import Path

import torch
from torch import Tensor

from crptpro.data.layout import Column
from crptpro.errors import DatasetError
from crptpro.host_memory import empty_batch

# Not in the mmap module of every Python; without it a mapping larger than RAM could be refused.
_MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)


def stack_rows(row: Tensor, step: Tensor, frame_stack: int) -> Tensor:
    """Return the frame rows of a stack, oldest to newest, int64 ``[B, frame_stack]``.

    Rows before the episode's first frame are that frame, as ``CatFrames(padding="same")`` does after a reset.

    Args:
        row: int64 ``[B]``, row of each observation's newest frame.
        step: ``[B]``, number of frames of the same episode before it.
        frame_stack: k, frames per stack.
    """
    age = torch.arange(frame_stack - 1, -1, -1, device=row.device)
    return row.unsqueeze(-1) - torch.minimum(age, step.to(torch.int64).unsqueeze(-1))


def gather_stacks(frames: Tensor, rows: Tensor) -> Tensor:
    """Gather ``[B, k]`` frame rows into stacks ``[B, k * C, H, W]``; contiguous, the dtype of ``frames``.

    Two separate gathers for an observation and its successor are faster than one of the k + 1 frames they
    share: the shared block would have to be copied again to be contiguous, and handing out overlapping views
    would let an in-place edit of one change the other.
    """
    batch, stack = rows.shape
    channels, *size = frames.shape[1:]
    flat = frames.reshape(len(frames), -1)
    shape = (batch * stack, flat.shape[1])
    stacks = empty_batch(shape, flat.dtype) if flat.device.type == "cpu" else flat.new_empty(shape)
    torch.index_select(flat, 0, rows.reshape(-1), out=stacks)
    return stacks.view(batch, stack * channels, *size)


def map_column(path: Path, column: Column, rows: int) -> Tensor:
    """Map a column's file without write access: it costs no memory, and writing to it leaves the file alone.

    Raises:
        DatasetError: if the file is missing or does not have exactly the expected size.
    """
    expected = rows * column.row_bytes
    try:
        with open(path, "rb") as file:
            size = file.seek(0, 2)
            if size != expected:
                raise DatasetError(size_problem(path, size, expected))
            flags = mmap.MAP_PRIVATE | _MAP_NORESERVE
            mapped = mmap.mmap(file.fileno(), size, flags=flags, prot=mmap.PROT_READ | mmap.PROT_WRITE)
    except OSError as reason:
        raise DatasetError(
            f"{path} is missing or unreadable ({reason}). Collect the dataset again."
        ) from None
    return torch.frombuffer(mapped, dtype=column.torch_dtype).view(rows, *column.shape)


def size_problem(path: Path, size: int, expected: int) -> str:
    """Say what is wrong with a file of ``size`` bytes where ``expected`` belong."""
    kind = "truncated" if size < expected else "longer than it should be"
    return f"{path} is {kind}: {size:,} bytes, the card promises {expected:,}. Collect the dataset again."

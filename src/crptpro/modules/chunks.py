"""The chunks of a batch side by side: each core does whole operations on its own chunk.

PyTorch's way is that all cores share every operation and wait for each other at its end. For a convolution of a small
chunk that wait is a good part of the time, and on a machine that is busy otherwise it is most of it: the cores that
have finished spin until the slowest comes back. Here they meet once per batch.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from crptpro.host_memory import empty_batch
from crptpro.modules.lone_threads import lone_threads
from crptpro.modules.watching import is_watched

T = TypeVar("T")
R = TypeVar("R")
ChunkFunction = Callable[[Tensor, Sequence[Tensor]], Tensor]

_pools: dict[int, ThreadPoolExecutor] = {}
_pools_lock = threading.Lock()
_is_passed_by = False


def apply_to_chunks(
    function: ChunkFunction, chunks: Sequence[Tensor], parameters: Sequence[Tensor]
) -> Tensor:
    """Return ``torch.cat([function(chunk, parameters) for chunk in chunks])``, computed side by side, contiguous.

    The gradient of every parameter is the sum over the chunks in their order, whatever the number of threads. There is
    no second derivative. Where somebody watches or changes the operations themselves (autocast, compiling, tracing,
    ``torch.func``), which other threads would not see, the chunks are computed here one after the other; compiling
    passes them by inside :func:`chunks_uncompiled`.

    Args:
        function: maps a chunk ``[n, ...]`` and the parameters to ``[n, ...]``; must be thread-safe.
        chunks: of the inputs, which receive no gradient.
        parameters: all tensors that ``function`` may differentiate by.

    Returns:
        ``[sum of n, ...]``.
    """
    if _is_passed_by:
        return _apply_uncompiled(function, chunks, parameters)
    return _apply(function, chunks, parameters)


@contextlib.contextmanager
def chunks_uncompiled() -> Iterator[None]:
    """Have what is compiled inside leave :func:`apply_to_chunks` alone, threads included.

    On two cores a compiled pre-training update was 13 % slower where the compiler had taken the chunks apart, and no
    slower than an uncompiled one where it had not.
    """
    global _is_passed_by
    before, _is_passed_by = _is_passed_by, True
    try:
        yield
    finally:
        _is_passed_by = before


def _apply(function: ChunkFunction, chunks: Sequence[Tensor], parameters: Sequence[Tensor]) -> Tensor:
    if is_watched():
        return torch.cat([function(chunk, parameters) for chunk in chunks]).contiguous()
    if torch.is_grad_enabled() and any(parameter.requires_grad for parameter in parameters):
        return _Chunks.apply(function, chunks, *parameters)
    whole = _Whole(chunks)
    map_side_by_side(lambda index: whole.set(index, function(chunks[index], parameters)), range(len(chunks)))
    return whole.get()


@torch.compiler.disable(reason="threads that compute side by side are nothing a compiler could see")
def _apply_uncompiled(
    function: ChunkFunction, chunks: Sequence[Tensor], parameters: Sequence[Tensor]
) -> Tensor:
    return _apply(function, chunks, parameters)


def map_side_by_side(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return ``[work(item) for item in items]``, on as many threads as PyTorch computes with here.

    Each thread computes its operations alone. Gradient mode is the caller's.
    """
    threads = min(torch.get_num_threads(), len(items))
    if threads <= 1:
        return [work(item) for item in items]
    is_recording = torch.is_grad_enabled()

    def in_thread(item: T) -> R:
        with torch.set_grad_enabled(is_recording):
            return work(item)

    return list(_pool(threads).map(in_thread, items))


def split_among_threads(work: Callable[[slice], None], count: int, *, smallest: int = 64) -> None:
    """Call ``work`` with the parts of ``range(count)``, one per thread, side by side.

    Args:
        work: does the items of a slice; must be thread-safe, and let other threads run for most of its time.
        count: items.
        smallest: items below which a part is not worth a thread.
    """
    parts = max(1, min(torch.get_num_threads(), count // smallest))
    bounds = [count * index // parts for index in range(parts + 1)]
    map_side_by_side(work, [slice(first, last) for first, last in itertools.pairwise(bounds)])


class _Whole:
    """The outputs of all chunks in one tensor; each is copied there by its own thread, while it is in cache.

    Rows follow each other in memory whatever the layout of the outputs.
    """

    def __init__(self, chunks: Sequence[Tensor]) -> None:
        self._first_rows = [0, *itertools.accumulate(chunk.shape[0] for chunk in chunks)]
        self._lock = threading.Lock()
        self._rows: Tensor | None = None

    def set(self, index: int, output: Tensor) -> None:
        with self._lock:
            if self._rows is None:
                shape = (self._first_rows[-1], *output.shape[1:])
                is_on_cpu = output.device.type == "cpu"
                self._rows = empty_batch(shape, output.dtype) if is_on_cpu else output.new_empty(shape)
        self._rows[self._first_rows[index] : self._first_rows[index + 1]] = output

    def get(self) -> Tensor:
        assert self._rows is not None
        return self._rows


class _Chunks(torch.autograd.Function):
    """Keeps one graph per chunk, so that the backward pass can go through them side by side too."""

    @staticmethod
    def forward(ctx: Any, function: ChunkFunction, chunks: Sequence[Tensor], *parameters: Tensor) -> Tensor:
        needs = [parameter.requires_grad for parameter in parameters]

        whole = _Whole(chunks)

        def record(index: int) -> tuple[list[Tensor], Tensor]:
            with torch.enable_grad():
                leaves = [p.detach().requires_grad_(need) for p, need in zip(parameters, needs)]
                output = function(chunks[index], leaves)
            whole.set(index, output.detach())
            return [leaf for leaf in leaves if leaf.requires_grad], output

        graphs = map_side_by_side(record, range(len(chunks)))
        ctx.needs = needs
        # On a saved tensor and not on the context: autograd frees those after the backward pass, while the context
        # lives as long as anybody holds the loss.
        carrier: Any = torch.empty(0)
        carrier.graphs = graphs
        ctx.save_for_backward(carrier)
        return whole.get()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        graphs = ctx.saved_tensors[0].graphs
        parts = gradient.split([output.shape[0] for _, output in graphs])

        def differentiate(job: tuple[tuple[list[Tensor], Tensor], Tensor]) -> tuple[Tensor, ...]:
            (leaves, output), part = job
            # Kept, because the caller may ask the outer graph for a second pass; it is freed together with that one.
            return torch.autograd.grad(output, leaves, part, retain_graph=True)

        sums: list[Tensor] | None = None
        for gradients in map_side_by_side(differentiate, list(zip(graphs, parts))):
            sums = list(gradients) if sums is None else [a + b for a, b in zip(sums, gradients)]
        found = iter(sums or [])
        return (None, None, *[next(found) if need else None for need in ctx.needs])


def _pool(threads: int) -> ThreadPoolExecutor:
    with _pools_lock:
        if threads not in _pools:
            _pools[threads] = lone_threads(threads, "chunks")
        return _pools[threads]


def _forget_pools() -> None:
    """Threads do not survive a fork; a child makes its own."""
    global _pools_lock
    _pools_lock = threading.Lock()
    _pools.clear()


os.register_at_fork(after_in_child=_forget_pools)

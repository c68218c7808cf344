"""The encoder's convolutions on a CPU: chunks of a batch side by side, ReLU within the convolution in bfloat16.

Both are kept for what they gain. Chunks on threads of their own: a pre-training update of 512 transitions in float32 on
two busy AVX2 cores took 6.0 s, against 10.5 s with the chunks one after the other on both cores and 8.2 s in one piece.
ReLU within the convolution, bfloat16 on two AMX cores: forward and backward 229 against 257 ms, forward alone 52
against 83 ms, together 14 % of an update (benchmarks/README.md).
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

T = TypeVar("T")
R = TypeVar("R")
ChunkFunction = Callable[[Tensor, Sequence[Tensor]], Tensor]

START_TIMEOUT_S = 60.0

_pools: dict[int, ThreadPoolExecutor] = {}
_pools_lock = threading.Lock()


def apply_to_chunks(
    function: ChunkFunction, chunks: Sequence[Tensor], parameters: Sequence[Tensor]
) -> Tensor:
    """Return ``torch.cat([function(chunk, parameters) for chunk in chunks])``, computed side by side, contiguous.

    PyTorch's way is that all cores share every operation and wait for each other at its end; here they meet once per
    batch. The gradient of every parameter is the sum over the chunks in their order, whatever the number of threads.
    There is no second derivative. Where somebody watches or changes the operations themselves (autocast, compiling,
    tracing, ``torch.func``), which other threads would not see, the chunks are computed one after the other.

    Args:
        function: maps a chunk ``[n, ...]`` and the parameters to ``[n, ...]``; must be thread-safe.
        chunks: of the inputs, which receive no gradient.
        parameters: all tensors that ``function`` may differentiate by.

    Returns:
        ``[sum of n, ...]``.
    """
    if _is_watched():
        return torch.cat([function(chunk, parameters) for chunk in chunks]).contiguous()
    if torch.is_grad_enabled() and any(parameter.requires_grad for parameter in parameters):
        return _Chunks.apply(function, chunks, *parameters)
    whole = _Whole(chunks)
    map_side_by_side(lambda index: whole.set(index, function(chunks[index], parameters)), range(len(chunks)))
    return whole.get()


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

    with _pools_lock:
        if threads not in _pools:
            _pools[threads] = lone_threads(threads, "chunks")
    return list(_pools[threads].map(in_thread, items))


def lone_threads(count: int, name: str) -> ThreadPoolExecutor:
    """Start threads whose tensor operations run on one core each; the caller's number of cores stays.

    Args:
        count: threads, all started when this returns.
        name: prefix of their names.

    Raises:
        RuntimeError: if the system does not start them.
    """
    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(count, thread_name_prefix=name)
    together = threading.Barrier(count)

    def compute_alone(_: int) -> None:
        together.wait(START_TIMEOUT_S)  # so that every thread of the pool gets one of these calls
        torch.get_num_threads()  # a thread's first question sets its number to the process's
        torch.set_num_threads(1)

    try:
        list(pool.map(compute_alone, range(count)))
    except BaseException:
        together.abort()  # or those that did start would wait for the others for ever, and the exit for them
        pool.shutdown(wait=False)
        raise
    finally:
        # The number is kept per thread, but some libraries take the last one set for all.
        torch.set_num_threads(before)
    return pool


def conv_relu_stack(
    images: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    strides: Sequence[int],
    *,
    largest: float | None = None,
) -> Tensor:
    """Return ``relu(conv(... relu(conv(images))))``, un-padded.

    In bfloat16 on a CPU every convolution rounds after its ReLU instead of before, which gives the same bits. There is
    no second derivative then, and images receive no gradient; where they need one, or somebody watches the operations,
    the operations are PyTorch's usual ones. So they are where a NaN could arise, which the library's ReLU turns into
    zero.

    Args:
        images: ``[n, C_0, H, W]`` in the dtype of the weights; the result has its memory layout.
        weights: of each convolution, ``[C_i, C_(i-1), k, k]``.
        biases: of each convolution, ``[C_i]``.
        strides: of each convolution.
        largest: what no absolute value of the images exceeds, NaN included; None where that is not known.

    Returns:
        ``[n, C, h, w]``, in the dtype of the images.
    """
    if largest is not None and _can_fuse(images) and _stays_finite(weights, biases, largest):
        maps: Tensor = _FusedStack.apply(images, tuple(strides), *weights, *biases)
        return maps
    for weight, bias, stride in zip(weights, biases, strides):
        images = F.relu(F.conv2d(images, weight, bias, stride=stride), inplace=True)
    return images


def _is_watched() -> bool:
    return (
        torch.compiler.is_compiling()
        or torch.jit.is_tracing()
        or torch.is_autocast_enabled("cpu")
        or is_in_torch_dispatch_mode()
        or torch._C._are_functorch_transforms_active()
    )


def _can_fuse(images: Tensor) -> bool:
    return bool(
        images.dtype == torch.bfloat16
        and images.device.type == "cpu"
        and images.shape[0] > 0
        and not images.requires_grad
        and not _is_watched()
        and torch.backends.mkldnn.enabled
        and _library_fuses()
    )


@torch.no_grad()
def _stays_finite(weights: Sequence[Tensor], biases: Sequence[Tensor], largest: float) -> bool:
    """Whether no map can overflow, by the sum of absolute values; false with NaN or infinity in a parameter."""
    bound = torch.tensor(largest)
    for weight, bias in zip(weights, biases):
        bound = bound * weight.float().abs().sum((1, 2, 3)).max() + bias.float().abs().max()
    return bool(bound < torch.finfo(torch.bfloat16).max)


@functools.cache
def _library_fuses() -> bool:
    library = torch.ops.mkldnn
    needed = ("_convolution_pointwise", "_is_mkldnn_bf16_supported")
    return (
        torch.backends.mkldnn.is_available()
        and all(hasattr(library, name) for name in needed)
        and bool(library._is_mkldnn_bf16_supported())
    )


class _FusedStack(torch.autograd.Function):
    """The whole stack at once: the gradients between its layers, which nobody else sees, are masked in place."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, strides: tuple[int, ...], *parameters: Tensor) -> Tensor:
        weights, biases = parameters[: len(strides)], parameters[len(strides) :]
        maps = [images]
        for weight, bias, stride in zip(weights, biases, strides):
            maps.append(
                torch.ops.mkldnn._convolution_pointwise(
                    maps[-1], weight, bias, [0, 0], [stride, stride], [1, 1], 1, "relu", [], None
                )
            )
        ctx.strides = strides
        ctx.save_for_backward(*maps, *weights)
        return maps[-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        layers = len(ctx.strides)
        maps, weights = ctx.saved_tensors[: layers + 1], ctx.saved_tensors[layers + 1 :]
        needs_weight, needs_bias = ctx.needs_input_grad[2 : 2 + layers], ctx.needs_input_grad[2 + layers :]
        found: list[Tensor | None] = [None] * (2 * layers)
        for layer in reversed(range(layers)):
            inputs, output = maps[layer], maps[layer + 1]
            if layer == layers - 1:
                # In the layout of the maps first: masking across two layouts takes several times as long.
                gradient = torch.ops.aten.threshold_backward(
                    torch.empty_like(output).copy_(gradient), output, 0
                )
            else:
                torch.ops.aten.threshold_backward.grad_input(gradient, output, 0, grad_input=gradient)
            is_needed_below = any(needs_weight[:layer]) or any(needs_bias[:layer])
            stride = ctx.strides[layer]
            gradient, found[layer], found[layers + layer] = torch.ops.aten.convolution_backward(
                gradient, inputs, weights[layer], [output.shape[1]], [stride, stride], [0, 0], [1, 1], False, [0, 0],
                1, [is_needed_below, needs_weight[layer], needs_bias[layer]],
            )  # fmt: skip
            if not is_needed_below:
                break
        return (None, None, *found)


class _Whole:
    """The outputs of all chunks in one tensor; each is copied there by its own thread, while it is in cache.

    Rows follow each other in memory whatever the layout of the outputs.
    """

    def __init__(self, chunks: Sequence[Tensor]) -> None:
        self._sizes = [chunk.shape[0] for chunk in chunks]
        self._lock = threading.Lock()
        self._parts: Sequence[Tensor] = ()
        self._rows: Tensor | None = None

    def set(self, index: int, output: Tensor) -> None:
        with self._lock:
            if self._rows is None:
                self._rows = output.new_empty(sum(self._sizes), *output.shape[1:])
                self._parts = self._rows.split(self._sizes)
        self._parts[index].copy_(output)

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


def _forget_pools() -> None:
    """Threads do not survive a fork; a child makes its own."""
    global _pools_lock
    _pools_lock = threading.Lock()
    _pools.clear()


os.register_at_fork(after_in_child=_forget_pools)

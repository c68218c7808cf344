"""Convolutions with ReLU, both in one pass over memory where the processor's library can.

A 3x3 convolution of 32 channels in bfloat16 is so little arithmetic on a CPU that multiplies matrices in hardware (AMX)
that ReLU as an operation of its own, which reads and writes everything once more, takes about as long.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from crptpro.modules.watching import is_watched

PADDING = [0, 0]
DILATION = [1, 1]
GROUPS = 1


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
    no second derivative then, and images receive no gradient; where they need one, or somebody watches the operations
    (:func:`~crptpro.modules.watching.is_watched`), the operations are PyTorch's usual ones. So they are where a NaN
    could arise, which the library's ReLU turns into zero.

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


def _can_fuse(images: Tensor) -> bool:
    return bool(
        images.dtype == torch.bfloat16
        and images.device.type == "cpu"
        and images.shape[0] > 0
        and not images.requires_grad
        and not is_watched()
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
                    maps[-1], weight, bias, PADDING, [stride, stride], DILATION, GROUPS, "relu", [], None
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
                gradient, inputs, weights[layer], [output.shape[1]], [stride, stride], PADDING, DILATION, False, [0, 0],
                GROUPS, [is_needed_below, needs_weight[layer], needs_bias[layer]],
            )  # fmt: skip
            if not is_needed_below:
                break
        return (None, None, *found)

"""Convolutions with ReLU in one pass: the bits and gradients of the two operations in turn."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from crptpro.modules import convolutions
from crptpro.modules.convolutions import conv_relu_stack

STRIDES = (2, 1, 1)
FUSES = convolutions._library_fuses()
LAYOUTS = [torch.channels_last, torch.contiguous_format]


def inputs(
    dtype: torch.dtype = torch.bfloat16, layout: torch.memory_format = torch.channels_last
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).to(dtype)

    channels = [3, 32, 32, 16]
    weights = [draw(out, into, 3, 3).requires_grad_() for into, out in itertools.pairwise(channels)]
    biases = [draw(out).requires_grad_() for out in channels[1:]]
    return draw(4, 3, 21, 21).contiguous(memory_format=layout), weights, biases


def in_turn(images: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    for weight, bias, stride in zip(weights, biases, STRIDES):
        images = F.relu(F.conv2d(images, weight, bias, stride=stride))
    return images


@pytest.fixture
def is_fused(monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Tell whether the fused stack has computed since the last question."""
    calls: list[None] = []
    apply = convolutions._FusedStack.apply

    def counted(*arguments: object) -> Tensor:
        calls.append(None)
        maps: Tensor = apply(*arguments)
        return maps

    monkeypatch.setattr(convolutions._FusedStack, "apply", counted)

    def asked() -> bool:
        was_called = bool(calls)
        calls.clear()
        return was_called

    return asked


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_maps_and_gradients_are_those_of_the_operations_in_turn(
    dtype: torch.dtype, layout: torch.memory_format, is_fused: Callable[[], bool]
) -> None:
    images, weights, biases = inputs(dtype, layout)
    found, expected = (
        conv_relu_stack(images, weights, biases, STRIDES, largest=10.0),
        in_turn(images, weights, biases),
    )
    assert is_fused() is (FUSES and dtype == torch.bfloat16)
    assert torch.equal(found, expected)
    assert found.stride() == expected.stride()
    upstream = torch.linspace(-1, 1, found.numel(), dtype=torch.float64).reshape(found.shape).to(dtype)
    leaves = [*weights, *biases]
    for one, two in zip(
        torch.autograd.grad(found, leaves, upstream), torch.autograd.grad(expected, leaves, upstream)
    ):
        tolerance = 1e-2 if dtype == torch.bfloat16 else 1e-5
        torch.testing.assert_close(one, two, rtol=0, atol=tolerance * two.abs().max().item())


def test_only_what_is_trained_gets_a_gradient_and_the_others_are_not_computed() -> None:
    images, weights, biases = inputs()
    expected = torch.autograd.grad(in_turn(images, weights, biases).sum(), [weights[2], biases[1]])
    for tensor in (weights[0], biases[0], weights[1], biases[2]):
        tensor.requires_grad_(False)
    conv_relu_stack(images, weights, biases, STRIDES, largest=10.0).sum().backward()
    torch.testing.assert_close((weights[2].grad, biases[1].grad), expected)
    assert all(tensor.grad is None for tensor in (weights[0], biases[0], weights[1], biases[2]))


def test_a_second_backward_pass_gives_the_same_and_the_upstream_gradient_stays() -> None:
    images, weights, biases = inputs()
    found = conv_relu_stack(images, weights, biases, STRIDES, largest=10.0)
    upstream = torch.ones_like(found)
    first = torch.autograd.grad(found, weights, upstream, retain_graph=True)
    second = torch.autograd.grad(found, weights, upstream)
    assert all(torch.equal(one, two) for one, two in zip(first, second))
    assert torch.equal(upstream, torch.ones_like(found))


def test_images_that_need_a_gradient_get_it(is_fused: Callable[[], bool]) -> None:
    images, weights, biases = inputs()
    images.requires_grad_()
    found = torch.autograd.grad(conv_relu_stack(images, weights, biases, STRIDES, largest=10.0).sum(), images)
    assert not is_fused()
    assert torch.equal(found[0], torch.autograd.grad(in_turn(images, weights, biases).sum(), images)[0])


def test_whoever_watches_the_operations_sees_the_usual_ones(is_fused: Callable[[], bool]) -> None:
    images, weights, biases = inputs()
    with FlopCounterMode(display=False) as counter:
        conv_relu_stack(images, weights, biases, STRIDES, largest=10.0)
    assert counter.get_total_flops() > 0
    torch.func.grad(
        lambda weight: conv_relu_stack(images, [weight, *weights[1:]], biases, STRIDES, largest=10.0).sum()
    )(weights[0].detach())
    assert not is_fused()


def test_without_the_library_the_operations_are_the_usual_ones(
    monkeypatch: pytest.MonkeyPatch, is_fused: Callable[[], bool]
) -> None:
    images, weights, biases = inputs()
    monkeypatch.setattr(convolutions, "_library_fuses", lambda: False)
    assert torch.equal(
        conv_relu_stack(images, weights, biases, STRIDES, largest=10.0), in_turn(images, weights, biases)
    )
    assert not is_fused()


@pytest.mark.skipif(not FUSES, reason="this processor's library does not fuse in bfloat16")
def test_a_second_derivative_is_refused() -> None:
    images, weights, biases = inputs()
    found = conv_relu_stack(images, weights, biases, STRIDES, largest=10.0)
    upstream = torch.ones_like(found).requires_grad_()
    first = torch.autograd.grad(found, weights[1], upstream, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e38])
@pytest.mark.parametrize("which", ["weight", "bias"])
def test_what_is_not_finite_propagates_from_parameters(
    bad: float, which: str, is_fused: Callable[[], bool]
) -> None:
    images, weights, biases = inputs()
    with torch.no_grad():
        (weights[1] if which == "weight" else biases[1]).view(-1)[0] = bad
    found = conv_relu_stack(images, weights, biases, STRIDES, largest=10.0)
    assert not is_fused()
    torch.testing.assert_close(found, in_turn(images, weights, biases), rtol=0, atol=0, equal_nan=True)
    if bad != bad:
        assert found.isnan().any()


def test_images_of_unknown_size_are_left_to_the_usual_operations(is_fused: Callable[[], bool]) -> None:
    images, weights, biases = inputs()
    images[0, 0, 0, 0] = float("nan")
    assert conv_relu_stack(images, weights, biases, STRIDES).isnan().any()
    assert not is_fused()


def test_an_empty_batch_is_legal() -> None:
    _, weights, biases = inputs()
    empty = torch.empty(0, 3, 21, 21, dtype=torch.bfloat16)
    assert conv_relu_stack(empty, weights, biases, STRIDES, largest=10.0).shape == (0, 16, 6, 6)

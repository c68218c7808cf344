"""Chunks side by side and ReLU within the convolution: the numbers of the plain operations, whatever the threads."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from crptpro.modules import PixelEncoder, convolutions
from crptpro.modules.convolutions import apply_to_chunks, conv_relu_stack, map_side_by_side

STRIDES = (2, 1, 1)
FUSES = convolutions._library_fuses()


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def affine(chunk: Tensor, parameters: Sequence[Tensor]) -> Tensor:
    weight, bias = parameters
    return torch.tanh(chunk @ weight + bias)


def rows() -> tuple[Tensor, list[Tensor]]:
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(7, 5, generator=generator)
    return images, [torch.randn(5, 3, generator=generator).requires_grad_(), torch.zeros(3).requires_grad_()]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_outputs_and_gradients_of_chunks_are_those_of_the_whole_batch(threads: int) -> None:
    torch.set_num_threads(threads)
    images, parameters = rows()
    expected = affine(images, parameters)
    found = apply_to_chunks(affine, images.split(2), parameters)
    assert found.is_contiguous()
    torch.testing.assert_close(found, expected)
    weights = torch.linspace(-1, 1, found.numel()).reshape(found.shape)
    before = weights.clone()
    first = torch.autograd.grad(found, parameters, weights, retain_graph=True)
    torch.testing.assert_close(first, torch.autograd.grad(expected, parameters, weights))
    torch.testing.assert_close(torch.autograd.grad(found, parameters, weights), first, rtol=0, atol=0)
    assert torch.equal(weights, before)


def test_the_number_of_threads_changes_no_bit_of_the_encoder() -> None:
    torch.manual_seed(0)
    encoder = PixelEncoder(3, channels=(8, 8), strides=(2, 1), image_size=21)
    encoder.micro_batch = 3
    images = torch.randint(0, 256, (11, 3, 21, 21), dtype=torch.uint8)
    for dtype in (torch.float32, torch.bfloat16):
        encoder.compute_dtype = dtype
        outcomes = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            encoder.zero_grad()
            features = encoder(images)
            features.float().square().sum().backward()
            outcomes.append([features, *[p.grad for p in encoder.parameters()]])
        assert all(torch.equal(first, second) for first, second in zip(*outcomes))


def test_every_thread_computes_alone_in_the_callers_gradient_mode() -> None:
    torch.set_num_threads(2)
    together = threading.Barrier(2)

    def look(_: int) -> tuple[int, int, bool]:
        together.wait(10)
        return threading.get_ident(), torch.get_num_threads(), torch.is_grad_enabled()

    for mode in (True, False):
        with torch.set_grad_enabled(mode):
            seen = map_side_by_side(look, [0, 1])
        assert len({ident for ident, *_ in seen}) == 2
        assert [rest for _, *rest in seen] == [[1, mode]] * 2
    assert torch.get_num_threads() == 2
    with torch.no_grad():
        assert not apply_to_chunks(affine, rows()[0].split(2), rows()[1]).requires_grad


def test_the_graphs_are_freed_by_the_backward_pass_although_somebody_keeps_the_loss() -> None:
    images, (weight, bias) = rows()
    activations: list[weakref.ref[Tensor]] = []

    def watched(chunk: Tensor, weights: Sequence[Tensor]) -> Tensor:
        hidden = affine(chunk, weights)
        activations.append(weakref.ref(hidden))
        return hidden.square()

    total = apply_to_chunks(watched, images.split(2), [weight.requires_grad_(False), bias]).sum()
    assert all(reference() is not None for reference in activations)
    total.backward()
    assert all(reference() is None for reference in activations)
    assert weight.grad is None
    assert bias.grad is not None


@pytest.mark.parametrize("threads", [1, 2])
def test_autocast_function_transforms_and_tracing_see_every_chunk(threads: int) -> None:
    torch.set_num_threads(threads)
    images, (weight, bias) = rows()
    with torch.autocast("cpu", torch.bfloat16):
        found = apply_to_chunks(affine, images.split(2), [weight, bias])
        assert torch.equal(found, torch.cat([affine(chunk, [weight, bias]) for chunk in images.split(2)]))
    assert not torch.equal(found, affine(images, [weight, bias]))

    def total(weight: Tensor) -> Tensor:
        return apply_to_chunks(affine, images.split(2), [weight, bias]).sum()

    expected = torch.autograd.grad(total(weight), weight)[0]
    torch.testing.assert_close(torch.func.grad(total)(weight.detach()), expected)
    with torch.no_grad():
        constants = [weight.detach(), bias.detach()]
        traced = torch.jit.trace(lambda x: apply_to_chunks(affine, x.split(2), constants), images)
        torch.testing.assert_close(traced(images + 1), affine(images + 1, constants))


def test_an_error_in_a_chunk_reaches_the_caller() -> None:
    torch.set_num_threads(2)

    def refuse(item: int) -> int:
        raise ValueError(f"chunk {item}")

    with pytest.raises(ValueError, match="chunk 0"):
        map_side_by_side(refuse, [0, 1, 2])


def test_a_forked_process_computes_and_threads_that_cannot_start_let_it_end() -> None:
    program = """
import os, threading, torch
from crptpro.modules import convolutions
torch.set_num_threads(2)
assert convolutions.map_side_by_side(lambda i: i, [1, 2, 3]) == [1, 2, 3]
child = os.fork()
if child == 0:
    os._exit(0 if convolutions.map_side_by_side(lambda i: i, [1, 2, 3]) == [1, 2, 3] else 1)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
convolutions.START_TIMEOUT_S = 0.5
start, count = threading.Thread.start, 0
def start_the_first_only(thread):
    global count
    count += 1
    if count > 1:
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = start_the_first_only
try:
    convolutions.lone_threads(2, "lone")
except RuntimeError as reason:
    print(reason)
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        env=os.environ,
    )
    assert done.stdout == "can't start new thread\n"


# ReLU within the convolution -----------------------------------------------------------------------------


def stack(
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
        return apply(*arguments)

    monkeypatch.setattr(convolutions._FusedStack, "apply", counted)

    def asked() -> bool:
        was_called = bool(calls)
        calls.clear()
        return was_called

    return asked


@pytest.mark.parametrize("layout", [torch.channels_last, torch.contiguous_format])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_maps_and_gradients_are_those_of_the_operations_in_turn(
    dtype: torch.dtype, layout: torch.memory_format, is_fused: Callable[[], bool]
) -> None:
    images, weights, biases = stack(dtype, layout)
    for frozen in (weights[0], biases[0]):
        frozen.requires_grad_(False)
    found = conv_relu_stack(images, weights, biases, STRIDES, largest=10.0)
    expected = in_turn(images, weights, biases)
    assert is_fused() is (FUSES and dtype == torch.bfloat16)
    assert torch.equal(found, expected)
    assert found.stride() == expected.stride()
    upstream = torch.linspace(-1, 1, found.numel(), dtype=torch.float64).reshape(found.shape).to(dtype)
    leaves = [*weights[1:], *biases[1:]]
    for one, two in zip(
        torch.autograd.grad(found, leaves, upstream), torch.autograd.grad(expected, leaves, upstream)
    ):
        tolerance = 1e-2 if dtype == torch.bfloat16 else 1e-5
        torch.testing.assert_close(one, two, rtol=0, atol=tolerance * two.abs().max().item())


def test_whoever_needs_the_usual_operations_gets_them(is_fused: Callable[[], bool]) -> None:
    images, weights, biases = stack()
    with FlopCounterMode(display=False) as counter:
        conv_relu_stack(images, weights, biases, STRIDES, largest=10.0)
    assert counter.get_total_flops() > 0
    torch.func.grad(
        lambda weight: conv_relu_stack(images, [weight, *weights[1:]], biases, STRIDES, largest=10.0).sum()
    )(weights[0].detach())
    images.requires_grad_()
    found = torch.autograd.grad(conv_relu_stack(images, weights, biases, STRIDES, largest=10.0).sum(), images)
    assert torch.equal(found[0], torch.autograd.grad(in_turn(images, weights, biases).sum(), images)[0])
    empty = torch.empty(0, 3, 21, 21, dtype=torch.bfloat16)
    assert conv_relu_stack(empty, weights, biases, STRIDES, largest=10.0).shape == (0, 16, 6, 6)
    assert not is_fused()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e38])
@pytest.mark.parametrize("which", ["weight", "bias", "image"])
def test_what_is_not_finite_propagates(bad: float, which: str, is_fused: Callable[[], bool]) -> None:
    images, weights, biases = stack()
    with torch.no_grad():
        spoilt = {"weight": weights[1], "bias": biases[1], "image": images}[which]
        spoilt[(0,) * spoilt.ndim] = bad
    found = conv_relu_stack(images, weights, biases, STRIDES, largest=None if which == "image" else 10.0)
    assert not is_fused()
    torch.testing.assert_close(found, in_turn(images, weights, biases), rtol=0, atol=0, equal_nan=True)
    assert found.isnan().any() or bad == bad

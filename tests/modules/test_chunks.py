"""Chunks side by side: the same numbers as one after the other, whatever the number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator, Sequence

import pytest
import torch
from torch import Tensor

from crptpro.modules import PixelEncoder
from crptpro.modules.chunks import apply_to_chunks, map_side_by_side, split_among_threads


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def affine(chunk: Tensor, parameters: Sequence[Tensor]) -> Tensor:
    weight, bias = parameters
    return torch.tanh(chunk @ weight + bias)


def inputs() -> tuple[Tensor, list[Tensor]]:
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(7, 5, generator=generator)
    return images, [torch.randn(5, 3, generator=generator).requires_grad_(), torch.zeros(3).requires_grad_()]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_outputs_and_gradients_are_those_of_the_whole_batch(threads: int) -> None:
    torch.set_num_threads(threads)
    images, parameters = inputs()
    expected = affine(images, parameters)
    found = apply_to_chunks(affine, images.split(2), parameters)
    torch.testing.assert_close(found, expected)
    weights = torch.linspace(-1, 1, found.numel()).reshape(found.shape)
    torch.testing.assert_close(
        torch.autograd.grad((found * weights).sum(), parameters),
        torch.autograd.grad((expected * weights).sum(), parameters),
    )


@pytest.mark.parametrize("is_recording", [True, False])
def test_the_whole_lies_contiguous_whatever_the_layout_of_the_parts(is_recording: bool) -> None:
    images = torch.arange(7 * 2 * 3 * 5, dtype=torch.float32).view(7, 2, 3, 5)
    scale = torch.ones(()).requires_grad_(is_recording)
    found = apply_to_chunks(
        lambda chunk, parameters: (chunk * parameters[0]).contiguous(memory_format=torch.channels_last),
        images.split(3),
        [scale],
    )
    assert found.is_contiguous()
    assert torch.equal(found, images)


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


def test_every_thread_computes_alone_and_the_callers_number_stays() -> None:
    torch.set_num_threads(2)
    together = threading.Barrier(2)

    def look(_: int) -> tuple[int, int]:
        together.wait(10)
        return threading.get_ident(), torch.get_num_threads()

    seen = map_side_by_side(look, [0, 1])
    assert len({ident for ident, _ in seen}) == 2
    assert [number for _, number in seen] == [1, 1]
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(("threads", "count", "parts"), [(2, 130, 2), (3, 200, 3), (2, 100, 1), (4, 0, 1)])
def test_items_are_split_evenly_among_the_threads_and_each_is_done_once(
    threads: int, count: int, parts: int
) -> None:
    torch.set_num_threads(threads)
    done: list[range] = []
    split_among_threads(lambda part: done.append(range(count)[part]), count)
    assert sorted(item for part in done for item in part) == list(range(count))
    assert len(done) == parts
    assert max(map(len, done)) - min(map(len, done)) <= 1


def test_gradient_mode_is_the_callers() -> None:
    torch.set_num_threads(2)
    images, parameters = inputs()
    with torch.no_grad():
        assert not apply_to_chunks(affine, images.split(2), parameters).requires_grad
        assert map_side_by_side(lambda _: torch.is_grad_enabled(), range(4)) == [False] * 4
    assert map_side_by_side(lambda _: torch.is_grad_enabled(), range(4)) == [True] * 4


def test_parameters_that_are_not_trained_get_no_gradient() -> None:
    images, (weight, bias) = inputs()
    apply_to_chunks(affine, images.split(2), [weight.requires_grad_(False), bias]).sum().backward()
    assert weight.grad is None
    assert bias.grad is not None


def test_a_second_backward_pass_gives_the_same_gradients() -> None:
    images, parameters = inputs()
    total = apply_to_chunks(affine, images.split(2), parameters).sum()
    first = torch.autograd.grad(total, parameters, retain_graph=True)
    torch.testing.assert_close(torch.autograd.grad(total, parameters), first, rtol=0, atol=0)


def test_the_graphs_are_freed_by_the_backward_pass_although_somebody_keeps_the_loss() -> None:
    images, parameters = inputs()
    activations: list[weakref.ref[Tensor]] = []

    def watched(chunk: Tensor, weights: Sequence[Tensor]) -> Tensor:
        hidden = affine(chunk, weights)
        activations.append(weakref.ref(hidden))
        return hidden.square()

    total = apply_to_chunks(watched, images.split(2), parameters).sum()
    assert all(reference() is not None for reference in activations)
    total.backward()
    assert all(reference() is None for reference in activations)
    with pytest.raises(RuntimeError, match="second time"):
        total.backward()


@pytest.mark.parametrize("threads", [1, 2])
def test_autocast_reaches_every_chunk(threads: int) -> None:
    torch.set_num_threads(threads)
    images, parameters = inputs()
    with torch.autocast("cpu", torch.bfloat16):
        found = apply_to_chunks(affine, images.split(2), parameters)
        assert torch.equal(found, torch.cat([affine(chunk, parameters) for chunk in images.split(2)]))
    assert not torch.equal(found, affine(images, parameters))


def test_function_transforms_and_tracing_see_every_chunk() -> None:
    torch.set_num_threads(2)
    images, (weight, bias) = inputs()

    def total(weight: Tensor, images: Tensor = images) -> Tensor:
        return apply_to_chunks(affine, images.split(2), [weight, bias]).sum()

    expected = torch.autograd.grad(total(weight), weight)[0]
    torch.testing.assert_close(torch.func.grad(total)(weight.detach()), expected)
    with torch.no_grad():
        constants = [weight.detach(), bias.detach()]
        traced = torch.jit.trace(lambda x: apply_to_chunks(affine, x.split(2), constants), images)
        torch.testing.assert_close(traced(images + 1), affine(images + 1, constants))


def test_an_upstream_gradient_is_not_written_to() -> None:
    images, _ = inputs()
    shift = torch.zeros(5).requires_grad_()
    found = apply_to_chunks(lambda chunk, parameters: chunk + parameters[0], images.split(1), [shift])
    upstream = torch.ones_like(found)
    found.backward(upstream)
    assert torch.equal(upstream, torch.ones_like(found))
    assert torch.equal(shift.grad, torch.full((5,), 7.0))  # type: ignore[arg-type]


def test_an_error_in_a_chunk_reaches_the_caller() -> None:
    torch.set_num_threads(2)

    def refuse(item: int) -> int:
        raise ValueError(f"chunk {item}")

    with pytest.raises(ValueError, match="chunk 0"):
        map_side_by_side(refuse, [0, 1, 2])


def test_a_forked_process_computes_too() -> None:
    program = """
import os, torch
from crptpro.modules.chunks import map_side_by_side
torch.set_num_threads(2)
assert map_side_by_side(lambda i: i, [1, 2, 3]) == [1, 2, 3]
child = os.fork()
if child == 0:
    os._exit(0 if map_side_by_side(lambda i: i, [1, 2, 3]) == [1, 2, 3] else 1)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60, env=os.environ)


def test_threads_that_cannot_all_start_do_not_keep_the_process_from_ending() -> None:
    program = """
import threading
from crptpro.modules import lone_threads
lone_threads.START_TIMEOUT_S = 0.5
start, count = threading.Thread.start, 0
def start_the_first_only(thread):
    global count
    count += 1
    if count > 1:
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = start_the_first_only
try:
    lone_threads.lone_threads(2, "lone")
except RuntimeError as reason:
    print(reason)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "can't start new thread\n"

"""Chunks side by side: the numbers of the plain operations, whatever the threads."""

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
from crptpro.modules.convolutions import apply_to_chunks


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    assert torch.get_num_threads() == request.param
    torch.set_num_threads(before)


def affine(chunk: Tensor, parameters: Sequence[Tensor]) -> Tensor:
    weight, bias = parameters
    return torch.tanh(chunk @ weight + bias)


def rows() -> tuple[Tensor, list[Tensor]]:
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(7, 5, generator=generator)
    return images, [torch.randn(5, 3, generator=generator).requires_grad_(), torch.zeros(3).requires_grad_()]


def test_every_thread_computes_alone_in_the_callers_gradient_mode_and_passes_errors_on(threads: int) -> None:
    together, seen = threading.Barrier(threads), []

    def look(chunk: Tensor, parameters: Sequence[Tensor]) -> Tensor:
        together.wait(10)
        seen.append((threading.get_ident(), torch.get_num_threads(), torch.is_grad_enabled()))
        return affine(chunk, parameters)

    images, parameters = rows()
    for mode in (True, False):
        with torch.set_grad_enabled(mode):
            apply_to_chunks(look, images[:2].split(1), parameters)
        assert len({ident for ident, *_ in seen}) == threads
        assert [rest for _, *rest in seen] == [[1, mode]] * 2
        seen.clear()

    def refuse(chunk: Tensor, parameters: Sequence[Tensor]) -> Tensor:
        raise ValueError(f"{len(chunk)} rows")

    with pytest.raises(ValueError, match="2 rows"):
        apply_to_chunks(refuse, images.split(2), parameters)


def test_the_graphs_are_freed_by_the_backward_pass_although_somebody_keeps_the_loss(threads: int) -> None:
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


def encoder_and_images() -> tuple[PixelEncoder, Tensor]:
    torch.manual_seed(0)
    encoder = PixelEncoder(3, channels=(8, 8), strides=(2, 1), image_size=21)
    encoder.micro_batch = 3
    return encoder, torch.randint(0, 256, (11, 3, 21, 21), dtype=torch.uint8)


def test_neither_the_number_of_threads_nor_a_second_backward_pass_changes_a_bit_of_the_encoder() -> None:
    (encoder, images), before = encoder_and_images(), torch.get_num_threads()
    parameters = list(encoder.parameters())
    for dtype in (torch.float32, torch.bfloat16):
        encoder.compute_dtype = dtype
        outcomes = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            features = encoder(images)
            for _ in range(2):
                gradients = torch.autograd.grad(features.float().square().sum(), parameters, retain_graph=True)
                outcomes.append([features, *gradients])
        for outcome in outcomes[1:]:
            assert all(torch.equal(first, second) for first, second in zip(outcomes[0], outcome))
    torch.set_num_threads(before)


def test_autocast_sees_the_operations_of_the_encoder() -> None:
    encoder, images = encoder_and_images()
    with torch.autocast("cpu", torch.bfloat16):
        assert encoder(images).dtype == torch.bfloat16


def test_a_forked_process_computes_and_threads_that_cannot_start_let_it_end() -> None:
    program = """
import os, threading, torch
from crptpro.modules import convolutions
torch.set_num_threads(2)
def compute():
    chunks = torch.arange(3.0).split(1)
    return convolutions.apply_to_chunks(lambda chunk, _: chunk, chunks, []).tolist() == [0, 1, 2]
assert compute()
child = os.fork()
if child == 0:
    os._exit(0 if compute() else 1)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
torch.set_num_threads(3)  # another pool
start, count = threading.Thread.start, 0
def start_the_first_only(thread):
    global count
    count += 1
    if count > 1:
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = start_the_first_only
try:
    compute()
except RuntimeError as reason:
    print(reason)
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, env=os.environ)
    assert done.stdout == "can't start new thread\n"

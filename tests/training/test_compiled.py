"""The switch `compile`: what it resolves to, and what happens where compiling fails."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._inductor.exc import InvalidCxxCompiler

from crptpro.errors import CompileError
from crptpro.modules import PixelEncoder, chunks
from crptpro.training.compiled import Compiled, resolve_compile


def test_only_on_compiles() -> None:
    assert [resolve_compile(switch) for switch in ("auto", "on", "off")] == [False, True, False]
    with pytest.raises(ValueError, match="`compile` must be 'auto', 'on' or 'off', got True"):
        resolve_compile(True)  # type: ignore[arg-type]


def test_switched_off_it_hands_back_the_function_itself() -> None:
    assert Compiled(is_on=False).wrap(torch.sin) is torch.sin


@pytest.fixture
def _no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            raise InvalidCxxCompiler

        return call

    monkeypatch.setattr(torch, "compile", compile)


@pytest.mark.usefixtures("_no_compiler")
def test_without_a_compiler_everything_runs_uncompiled_with_one_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    compiled = Compiled(is_on=True, is_required=False)
    double, triple = (compiled.wrap(lambda x, by=by: x * by) for by in (2, 3))
    with caplog.at_level(logging.WARNING):
        results = [compiled.attempt(lambda: double(torch.ones(()))).item() for _ in range(2)]
        results.append(compiled.attempt(lambda: triple(torch.ones(()))).item())
    assert results == [2.0, 2.0, 3.0]
    assert not compiled.is_on
    assert [record.message.split(":")[0] for record in caplog.records] == [
        "torch.compile failed, so updates run uncompiled"
    ]


@pytest.mark.usefixtures("_no_compiler")
def test_asked_for_it_is_an_error_that_says_what_is_missing() -> None:
    compiled = Compiled(is_on=True)
    work = compiled.wrap(torch.sin)
    with pytest.raises(CompileError, match=r"needs a C\+\+ compiler .* compile='off' works without"):
        compiled.attempt(lambda: work(torch.ones(())))


def test_errors_of_what_is_compiled_pass_through() -> None:
    def fail() -> Tensor:
        raise KeyError("pixels")

    with pytest.raises(KeyError, match="pixels"):
        Compiled(is_on=True, is_required=False).attempt(fail)


def test_a_compiled_encoder_leaves_its_chunks_to_their_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    compile = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **options: compile(f, backend="aot_eager", **options))
    seen: list[bool] = []
    watched = chunks.is_watched
    monkeypatch.setattr(chunks, "is_watched", lambda: seen.append(watched()) or seen[-1])
    encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=12)
    encoder.micro_batch = 2
    pixels = torch.randint(0, 256, (6, 3, 12, 12), dtype=torch.uint8)
    expected = encoder(pixels)
    features = Compiled(is_on=True).wrap(lambda x: encoder(x) * 2)(pixels)
    torch.testing.assert_close(features, expected * 2)
    assert seen == [False, False]  # run, and not traced
    assert features.requires_grad

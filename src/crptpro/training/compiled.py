"""The switch ``compile``: what it resolves to on a machine, and what happens where compiling fails."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

import torch

from crptpro.errors import CompileError
from crptpro.modules.chunks import chunks_uncompiled
from crptpro.switches import Switch, check_switch

_LOG = logging.getLogger(__name__)

R = TypeVar("R")

#: Packages whose exceptions say that compiling failed and not what was compiled.
_COMPILERS = ("torch._dynamo", "torch._inductor", "torch._functorch", "triton")


def resolve_compile(compile: Switch) -> bool:
    """Whether updates are compiled with ``torch.compile``; ``"auto"`` does not.

    Nobody has measured it on a GPU yet (``python -m benchmarks.gpu`` does). On a CPU nearly all of an update is
    convolutions and large matrix products, which the compiler leaves to the same library calls: it takes half a minute
    and gains nothing that can be told from noise (benchmarks/README.md).

    Args:
        compile: ``"auto"``, ``"on"`` or ``"off"``.

    Raises:
        ValueError: any other value.
    """
    check_switch("compile", compile)
    return compile == "on"


class Compiled:
    """Functions compiled when they are first called, or left alone.

    Args:
        is_on: whether to compile at all.
        is_required: compiling that fails is an error; otherwise a warning, and everything runs uncompiled.
    """

    def __init__(self, *, is_on: bool, is_required: bool = True) -> None:
        self.is_on = is_on
        self.is_required = is_required

    def wrap(self, function: Callable[..., R]) -> Callable[..., R]:
        """Return ``function``, compiled for the shapes it is called with as long as the switch stays on."""
        if not self.is_on:
            return function
        compiled = torch.compile(function, dynamic=False)

        def call(*arguments: Any, **keywords: Any) -> R:
            if not self.is_on:
                return function(*arguments, **keywords)
            with chunks_uncompiled():
                return compiled(*arguments, **keywords)

        return call

    def attempt(self, work: Callable[[], R]) -> R:
        """Return ``work()``, which calls wrapped functions; where they do not compile, call it again without.

        Args:
            work: must be repeatable up to the place where compiling can fail, the backward pass included.

        Raises:
            CompileError: if compiling fails and is required.
        """
        if not self.is_on:
            return work()
        try:
            return work()
        except Exception as reason:
            if not _is_of_a_compiler(reason):
                raise
            what = (str(reason).strip().splitlines() or [type(reason).__name__])[0]
            what = what.rstrip(".") + "."
            advice = "It needs a C++ compiler (CXX=...), on a GPU Triton too"
            if self.is_required:
                raise CompileError(
                    f"torch.compile failed: {what} {advice}; compile='off' works without."
                ) from reason
            _LOG.warning("torch.compile failed, so updates run uncompiled: %s %s.", what, advice)
            self.is_on = False
            return work()


def _is_of_a_compiler(reason: BaseException) -> bool:
    kinds = {kind.__module__ for kind in type(reason).__mro__}
    return any(module.startswith(_COMPILERS) for module in kinds)

"""Learner: the captured update on static batches against the plain one, and the compiled loss against eager."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from host_reads import NoHostReads
from pretrain_world import SETTINGS, make_datasets, make_loss, same_state
from tensordict import TensorDict

from crptpro.errors import NonFiniteError
from crptpro.objectives import method_defaults
from crptpro.training import pretrain
from crptpro.training.compiled import Compiled
from crptpro.training.pretrain.learner import Learner

UPDATES = 6


def make_learner(**options: Any) -> Learner:
    loss = make_loss()
    defaults = method_defaults(loss)
    changes = options.pop("defaults", {})
    return Learner(
        loss.train(), dataclasses.replace(defaults, **changes), learning_rate=1e-3, encoder_tau=0.05,
        updates=UPDATES, **options,
    )  # fmt: skip


def batches() -> list[TensorDict]:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(0, 256, (UPDATES + 1, 8, 3, 16, 16), dtype=torch.uint8, generator=generator)
    return [
        TensorDict({"pixels": one, "next": {"pixels": two}}, [8]) for one, two in itertools.pairwise(pixels)
    ]


def train(learner: Learner, first: int = 0, last: int = UPDATES) -> torch.Tensor:
    steps = range(first, last)
    return torch.stack([learner.update(batches()[i], index=i, domain="walker") for i in steps])


def test_a_captured_update_computes_what_a_plain_one_does() -> None:
    plain, captured = make_learner(), make_learner(captures=True)
    assert torch.equal(train(plain), train(captured))
    assert same_state(plain.loss, captured.loss)


def test_a_captured_update_never_reads_a_value_back() -> None:
    learner = make_learner(captures=True, defaults={"grad_clip": 1.0})
    with NoHostReads():
        train(learner)


def test_a_scheduled_rate_is_a_tensor_that_each_update_fills() -> None:
    schedule = {"schedule": "warmup_cosine", "warmup_updates": 2}
    plain, captured = make_learner(defaults=schedule), make_learner(defaults=schedule, captures=True)
    rate = captured.optimizer.param_groups[0]["lr"]
    rates = []
    for index in range(UPDATES):
        for learner in (plain, captured):
            learner.update(batches()[index], index=index, domain="walker")
        assert captured.optimizer.param_groups[0]["lr"] is rate
        rates.append((plain.optimizer.param_groups[0]["lr"], float(rate)))
    assert [one for one, _ in rates][:3] == [0.0, 5e-4, 1e-3]
    assert all(two == pytest.approx(one, rel=1e-6) for one, two in rates)
    for one, two in zip(plain.loss.parameters(), captured.loss.parameters()):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-6)


@pytest.mark.parametrize("schedule", ["constant", "warmup_cosine"])
def test_a_run_is_continued_with_and_without_capturing(schedule: str) -> None:
    changes = {"schedule": schedule, "warmup_updates": 2}
    whole, first, second = (
        make_learner(defaults=changes, captures=captures) for captures in (False, True, False)
    )
    train(whole)
    train(first, last=2)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    assert type(second.optimizer.param_groups[0]["lr"]) is float
    assert second.optimizer.param_groups[0]["capturable"] is False
    train(second, first=2, last=4)
    first.load_state_dict(copy.deepcopy(second.state_dict()))
    train(first, first=4)
    for one, two in zip(whole.loss.parameters(), first.loss.parameters()):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-6)


def test_a_captured_update_that_goes_wrong_is_named_at_the_next_check() -> None:
    learner = make_learner(captures=True)
    train(learner, last=2)
    bad = batches()[2].to(torch.float32)
    learner.captured.forget()
    for index, batch in enumerate((bad, bad * float("nan"), bad), start=2):
        learner.update(batch, index=index, domain="walker")
    with pytest.raises(NonFiniteError, match="Update 4: loss_comp is not finite"):
        learner.check(5)


@pytest.fixture
def _fails_in_the_backward_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiler that, as inductor does, compiles the backward pass when it is first needed, and cannot."""

    class Refuse(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, value: torch.Tensor) -> torch.Tensor:
            return value.clone()

        @staticmethod
        def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
            raise torch._inductor.exc.CppCompileError(["c++"], "no such file")

    def compile(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        def call(batch: TensorDict) -> TensorDict:
            out = function(batch)
            out["loss_comp"] = Refuse.apply(out["loss_comp"])
            return out

        return call

    monkeypatch.setattr(torch, "compile", compile)


@pytest.mark.usefixtures("_fails_in_the_backward_pass")
def test_a_failed_compilation_leaves_no_trace_in_the_numbers() -> None:
    plain = make_learner()
    fallen = make_learner(compiled=Compiled(is_on=True, is_required=False))
    assert torch.equal(train(plain), train(fallen))
    assert same_state(plain.loss, fallen.loss)


@pytest.mark.slow
def test_compiled_pretraining_agrees_with_eager_and_says_so() -> None:
    results, losses = {}, {}
    for switch in ("off", "on"):
        losses[switch] = make_loss()
        losses[switch].encoder.micro_batch = 4
        results[switch] = pretrain(losses[switch], make_datasets(), updates=6, compile=switch, **SETTINGS)
        assert losses[switch].training_record["compile"] is (switch == "on")
    eager, compiled = ([row["loss"] for row in results[switch].history] for switch in ("off", "on"))
    assert compiled == pytest.approx(eager, abs=1e-5)
    for one, two in zip(losses["off"].parameters(), losses["on"].parameters()):
        torch.testing.assert_close(one, two, rtol=0, atol=2e-4)

"""The check that the doctor runs: one domain that fails, crashes or hangs hides no other."""

from __future__ import annotations

from typing import Any

import pytest

from crptpro.envs import render_check
from crptpro.envs.render_check import check_domain, render_domains
from crptpro.errors import CRPTproError, RenderingError


def answer(*names: str) -> str:
    return "".join(
        f'{{"domain": "{name}", "agent_step_ms": 9.0, "reset_ms": 1.0, "alive": true, "error": ""}}\n'
        for name in names
    )


def runs(monkeypatch: pytest.MonkeyPatch, *results: tuple[int | None, str, str]) -> list[tuple[str, ...]]:
    """Let the processes end so, one after another; returns the domains that each was asked for."""
    asked: list[tuple[str, ...]] = []
    left = list(results)

    def run_isolated(commands: Any, backend: str, *, timeout_s: float) -> Any:
        asked.append(commands[0][3:])
        return [left.pop(0)]

    monkeypatch.setattr(render_check, "run_isolated", run_isolated)
    monkeypatch.setattr(render_check, "loaded_plugins", tuple)  # none, whatever other tests have loaded
    return asked


@pytest.mark.parametrize(
    ("reason", "error"),
    [
        (ValueError("Model is broken"), "ValueError: Model is broken"),
        (CRPTproError("no camera 7"), "no camera 7"),
    ],
)
def test_a_domain_that_fails_is_reported(
    monkeypatch: pytest.MonkeyPatch, reason: Exception, error: str
) -> None:
    def make_env(*_: Any, **__: Any) -> None:
        raise reason

    monkeypatch.setattr(render_check, "make_env", make_env)
    entry = check_domain("walker")
    assert (entry["domain"], entry["alive"], entry["error"]) == ("walker", False, error)


def test_a_missing_module_is_not_the_backends_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    reasons = iter(
        [ModuleNotFoundError("pygame"), CRPTproError("no camera 7"), RenderingError("black"), OSError()]
    )

    def make_env(*_: Any, **__: Any) -> None:
        raise next(reasons)

    monkeypatch.setattr(render_check, "make_env", make_env)
    assert [check_domain("walker")["is_drawing"] for _ in range(4)] == [False, False, True, True]


def test_domains_after_one_that_ended_the_process_are_checked_by_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = runs(
        monkeypatch, (1, answer("walker"), "a\nboom\n"), (-11, "", ""), (0, answer("finger", "hopper"), "")
    )
    entries = render_domains(("walker", "cheetah", "dog", "finger", "hopper"), "egl", 60.0)
    assert [entry["domain"] for entry in entries] == ["walker", "cheetah", "dog", "finger", "hopper"]
    assert [entry["error"] for entry in entries] == ["", "boom", "signal 11", "", ""]
    assert asked[1:] == [("dog", "finger", "hopper"), ("finger", "hopper")]


def test_a_process_that_does_not_answer_in_time_is_not_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = runs(monkeypatch, (None, answer("walker"), ""))
    walker, *others = render_domains(("walker", "cheetah", "dog"), "egl", 2.0)
    assert walker["alive"]
    assert [entry["error"] for entry in others] == ["no answer within 2 s"] * 2
    assert len(asked) == 1

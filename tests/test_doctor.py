"""The doctor: one thing that is wrong with a machine at a time, and how a domain that fails hides no other."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from crptpro import doctor
from crptpro.doctor import check_domain, check_versions, render_domains, run_doctor
from crptpro.envs import rendering
from crptpro.errors import CRPTproError, RenderingError, UnknownNameError


def answers(monkeypatch: pytest.MonkeyPatch, **entry: Any) -> list[str]:
    """Make every domain answer without being rendered; returns the names that were asked for."""
    asked: list[str] = []

    def render(names: list[str], *_: Any) -> list[dict[str, Any]]:
        asked.extend(names)
        return [{"domain": n, "error": "", "reset_ms": 200.0, "agent_step_ms": 15.0, **entry} for n in names]

    monkeypatch.setattr(doctor, "render_domains", render)
    return asked


def have_hardware(
    monkeypatch: pytest.MonkeyPatch, *, ram: float = 16e9, disk: float = 100e9, gpus: Sequence[str] = ()
) -> None:
    machine = {"cpu": "x", "cpu_instructions": "AVX2", "cpu_cores": 2, "ram_bytes": 16e9, "gpus": gpus}
    monkeypatch.setattr(doctor.provenance, "hardware", lambda: machine)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=disk))
    monkeypatch.setattr(doctor, "free_bytes", lambda _: ram)


@pytest.fixture(autouse=True)
def _healthy_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which everything works, without rendering anything; tests break one thing each."""
    monkeypatch.setattr(rendering, "select_backend", lambda: "egl")
    monkeypatch.setattr(rendering, "backend_card", lambda: {"gl_renderer": "llvmpipe", "gl_kind": "software"})
    answers(monkeypatch)
    have_hardware(monkeypatch)


def test_a_healthy_machine_is_ok_and_every_domain_is_shown() -> None:
    report = run_doctor()
    assert report.ok
    for part in ("mujoco", "torchrl", "egl (llvmpipe", "manipulation", "15.0", "100.0 GB", "can run"):
        assert part in report.text()
    assert "error" not in report.text()


def test_a_machine_on_which_nothing_renders_is_not_ok_and_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def select_backend() -> None:
        raise RenderingError("no libEGL")

    monkeypatch.setattr(rendering, "select_backend", select_backend)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    text = run_doctor(["cartpole"]).text()
    assert "error: no libEGL\n" in text
    assert "Unset MUJOCO_GL" not in text
    assert text.endswith("This machine cannot run crptpro.")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert "error: no libEGL\n  what to do: Unset MUJOCO_GL" in run_doctor(["cartpole"]).text()


def test_a_domain_that_fails_is_an_error_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    answers(monkeypatch, error="boom", remedy="Try another backend")
    report = run_doctor(["cartpole"])
    assert not report.ok
    assert "cartpole with egl: boom\n  what to do: Try another backend" in report.text()


def test_domains_that_do_not_need_gl_are_checked_on_a_machine_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "select_backend", lambda: pytest.fail("GL was tested"))
    asked = answers(monkeypatch, error="boom", remedy="Try another backend")
    text = run_doctor(["gymnasium:Pendulum-v1"]).text()
    assert asked == ["gymnasium:Pendulum-v1"]
    assert "rendering without GL" in text
    assert "error: gymnasium:Pendulum-v1: boom\n" in text
    assert "another backend" not in text


def test_group_letters_are_domains_and_unknown_names_are_refused_before_rendering(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = answers(monkeypatch)
    with pytest.raises(UnknownNameError, match="walkr"):
        run_doctor(["D", "walkr"])
    assert asked == []
    run_doctor(["D"])
    assert asked == ["walker", "pendulum", "hopper"]


@pytest.mark.parametrize(("found", "severity", "words"), [
    ({"disk": 0.1e9}, "error", "Free space"),
    ({"disk": 3e9}, "warning", "Free space"),
    ({"ram": 1e9}, "error", "End other programs"),
    ({"ram": 3e9}, "warning", "End other programs"),
    ({"gpus": ["unusable: driver too old"]}, "warning", "torch cannot use a GPU: unusable: driver too old."),
    ({"gpus": ["A GPU"]}, "warning", "in software"),
])  # fmt: skip
def test_what_a_machine_lacks_is_an_error_or_a_warning_with_its_remedy(
    monkeypatch: pytest.MonkeyPatch, found: dict[str, Any], severity: str, words: str
) -> None:
    have_hardware(monkeypatch, **found)
    report = run_doctor(["cartpole"])
    assert (report.findings[0].severity, report.ok) == (severity, severity == "warning")
    assert report.findings[0].remedy
    assert words in report.text()


@pytest.mark.parametrize(("installed", "severity", "words"), [
    ({"mujoco": "4.0.0", "torch": "2.13.0+cpu"}, "error", "mujoco 4.0.0"),
    ({"torch": "2.13.0"}, "error", "not installed"),
    ({"mujoco": "3.17.0", "torch": "2.20.0"}, "warning", "is untested"),
])  # fmt: skip
def test_versions_out_of_range_are_reported_with_their_remedy(
    installed: dict[str, str], severity: str, words: str
) -> None:
    (finding,) = check_versions(installed, ["mujoco>=3.17,<4", "torch>=2.11,<2.14"])
    assert finding.severity == severity
    assert words in finding.what
    assert "pip" in finding.remedy


@pytest.mark.parametrize(("reason", "error", "is_drawing"), [
    (ValueError("Model is broken"), "ValueError: Model is broken", True),
    (ModuleNotFoundError("pygame"), "ModuleNotFoundError: pygame", False),
    (CRPTproError("no camera 7"), "no camera 7", False),
    (RenderingError("black"), "black", True),
])  # fmt: skip
def test_a_failing_domain_is_reported_and_a_missing_package_is_not_blamed_on_the_backend(
    monkeypatch: pytest.MonkeyPatch, reason: Exception, error: str, is_drawing: bool
) -> None:
    def make_env(*_: Any, **__: Any) -> None:
        raise reason

    monkeypatch.setattr("crptpro.envs.make_env", make_env)
    entry = check_domain("walker")
    assert (entry["domain"], entry["error"]) == ("walker", error)
    assert ("another backend" in entry["remedy"]) == is_drawing


def test_a_domain_that_crashes_or_hangs_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    found = {"walker": (1, "", "a\nboom\n"), "dog": (-11, "", ""), "fish": (None, "", ""), "finger": (0, "{}\n", "")}
    asked: list[str] = []

    def run_isolated(commands: Any, backend: str, *, timeout_s: float) -> Any:
        asked.append(commands[0][-1])
        return [found[asked[-1]]]

    monkeypatch.setattr(rendering, "run_isolated", run_isolated)
    entries = render_domains(tuple(found), "egl", 60.0)
    assert asked == list(found)
    assert [entry.get("error") for entry in entries] == ["boom", "signal 11", "no answer within 60 s", None]


@pytest.mark.gl
def test_a_real_domain_is_rendered_and_timed_in_its_own_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    (entry,) = render_domains(("cartpole",), rendering.select_backend(), 300.0)
    assert entry["error"] == ""
    assert entry["agent_step_ms"] > 0

"""The doctor: one thing that is wrong with a machine at a time, and how a domain that fails hides no other."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest

from crptpro import doctor
from crptpro.doctor import check_domain, check_versions, render_domains, run_doctor
from crptpro.envs import rendering
from crptpro.errors import CRPTproError, RenderingError, UnknownNameError

PROBE = """import os
print('{"gl_vendor": "Mesa", "gl_renderer": "llvmpipe", "gl_kind": "software", "alive": true}')"""
MACHINE = {"cpu": "x", "cpu_instructions": "AVX2", "cpu_cores": 2, "ram_bytes": 16e9, "gpus": []}


def answers(monkeypatch: pytest.MonkeyPatch, **entry: Any) -> list[str]:
    """Make every domain answer without being rendered; returns the names that were asked for."""
    asked: list[str] = []

    def render(names: list[str], *_: Any) -> list[dict[str, Any]]:
        asked.extend(names)
        return [{"domain": n, "error": "", "reset_ms": 200.0, "agent_step_ms": 15.0, **entry} for n in names]

    monkeypatch.setattr(doctor, "render_domains", render)
    return asked


def probe_with(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    monkeypatch.setattr(rendering, "PROBE_COMMAND", (sys.executable, "-S", "-c", code))


def with_room(monkeypatch: pytest.MonkeyPatch, ram: float, disk: float) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=disk))
    monkeypatch.setattr(doctor.psutil, "virtual_memory", lambda: SimpleNamespace(available=ram, total=ram))


@pytest.fixture(autouse=True)
def _healthy_machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine on which everything works, without rendering anything; tests break one thing each."""
    probe_with(monkeypatch, PROBE)
    answers(monkeypatch)
    monkeypatch.setattr(rendering, "_imported_backend", lambda: None)
    with_room(monkeypatch, ram=16e9, disk=100e9)
    with mock.patch.dict(os.environ):
        for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", rendering.PROOF_VARIABLE):
            os.environ.pop(name, None)
        yield


def test_a_healthy_machine_is_ok_and_every_domain_is_shown() -> None:
    report = run_doctor()
    assert report.ok
    for part in ("mujoco", "torchrl", "egl (llvmpipe", "manipulation", "15.0", "100.0 GB", "would work"):
        assert part in report.text()
    assert "error" not in report.text()


@pytest.mark.parametrize(("code", "gl", "parts"), [
    ("raise SystemExit('no GL')", None, ("No GL backend renders", "no GL", "apt-get install")),
    ("import time; time.sleep(600)", None, ("did not arrive within 0.5 s", "MUJOCO_GL=osmesa")),
    ("raise SystemExit('no GL')", "osmesa", ("MUJOCO_GL=osmesa was set by you", "Unset MUJOCO_GL")),
    (PROBE, "off", ("switches rendering off",)),
])  # fmt: skip
def test_a_machine_on_which_nothing_renders_is_not_ok_and_told_why(
    monkeypatch: pytest.MonkeyPatch, code: str, gl: str | None, parts: tuple[str, ...]
) -> None:
    probe_with(monkeypatch, code)
    os.environ.update({"MUJOCO_GL": gl} if gl else {}, **{rendering.TIMEOUT_VARIABLE: "0.5"} if "sleep" in code else {})
    report = run_doctor(["cartpole"])
    assert not report.ok
    for part in (*parts, "would not work"):
        assert part in report.text()


def test_one_backend_is_enough(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    probe_with(monkeypatch, f"import os\nif os.environ['MUJOCO_GL'] == 'egl': raise SystemExit('no EGL')\n{PROBE}")
    report = run_doctor(["cartpole"])
    assert report.ok
    assert "rendering with osmesa" in report.text()
    assert "no EGL" in caplog.text


def test_a_domain_that_fails_is_an_error_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    answers(monkeypatch, error="boom", remedy="Try another backend")
    report = run_doctor(["cartpole"])
    assert not report.ok
    assert "cartpole with egl: boom\n  what to do: Try another backend" in report.text()


def test_group_letters_are_domains_and_unknown_names_are_refused_before_rendering(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = answers(monkeypatch)
    with pytest.raises(UnknownNameError, match="walkr"):
        run_doctor(["D", "walkr"])
    assert asked == []
    run_doctor(["D"])
    assert asked == ["walker", "pendulum", "hopper"]


@pytest.mark.parametrize(("gpu", "words"), [
    ("unusable: driver too old", "torch cannot use a GPU: unusable: driver too old."), ("A GPU", "in software"),
])  # fmt: skip
def test_a_gpu_that_is_not_used_is_a_warning(monkeypatch: pytest.MonkeyPatch, gpu: str, words: str) -> None:
    monkeypatch.setattr(doctor.provenance, "hardware", lambda: {**MACHINE, "gpus": [gpu]})
    report = run_doctor(["cartpole"])
    assert report.ok
    assert words in report.text()


@pytest.mark.parametrize(
    ("ram", "disk", "severity"),
    [(16e9, 0.1e9, "error"), (16e9, 3e9, "warning"), (1e9, 100e9, "error"), (3e9, 100e9, "warning")],
)
def test_little_memory_or_disk_is_reported_with_its_remedy(
    monkeypatch: pytest.MonkeyPatch, ram: float, disk: float, severity: str
) -> None:
    with_room(monkeypatch, ram, disk)
    report = run_doctor(["cartpole"])
    assert report.findings[0].severity == severity
    assert report.findings[0].remedy
    assert report.ok == (severity == "warning")


@pytest.mark.parametrize(("installed", "severity", "words"), [
    ({"mujoco": "3.17.0", "torch": "2.13.0+cpu"}, None, ""),
    ({"mujoco": "4.0.0", "torch": "2.13.0"}, "error", "mujoco 4.0.0"),
    ({"torch": "2.13.0"}, "error", "not installed"),
    ({"mujoco": "3.17.0", "torch": "2.13.0", "mujoco-core": "4.0.0"}, "warning", "mujoco-core"),
    ({"mujoco": "3.17.0", "torch": "2.20.0"}, "warning", "is untested"),
])  # fmt: skip
def test_versions_out_of_range_are_reported_with_their_remedy(
    installed: dict[str, str], severity: str | None, words: str
) -> None:
    findings = check_versions(installed, ["mujoco>=3.17,<4", "torch>=2.11,<2.14"])
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    for finding in findings:
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

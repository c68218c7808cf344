from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from unittest import mock

import pytest

from crptpro import doctor
from crptpro.doctor import check_versions, run_doctor
from crptpro.envs import gl_process, render_check
from crptpro.errors import UnknownNameError

ALIVE = {"domain": "cartpole", "reset_ms": 200.0, "agent_step_ms": 15.0, "alive": True, "error": ""}
PROBE = """import json, os
print(json.dumps(dict(gl_vendor='Mesa', gl_renderer='llvmpipe', gl_version='4.5', gl_kind='software', alive=True)))"""


@pytest.fixture(autouse=True)
def _healthy_machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine on which everything works, without rendering anything; tests break one thing each."""
    monkeypatch.setattr(gl_process, "PROBE_COMMAND", (sys.executable, "-S", "-c", PROBE))
    monkeypatch.setattr(
        render_check, "render_domains", lambda names, *_: tuple({**ALIVE, "domain": n} for n in names)
    )
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=100e9))
    monkeypatch.setattr(doctor.psutil, "virtual_memory", lambda: SimpleNamespace(available=16e9, total=16e9))
    with mock.patch.dict(os.environ):
        for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
            os.environ.pop(name, None)
        yield


def test_a_healthy_machine_is_ok_and_every_domain_and_backend_is_shown() -> None:
    report = run_doctor()
    assert report.ok
    assert [check.backend for check in report.backends] == ["egl", "osmesa"]
    assert [check.is_chosen for check in report.backends] == [True, False]
    text = report.text()
    for part in (
        "mujoco",
        "torchrl",
        "llvmpipe",
        "manipulation",
        "quadruped",
        "15.0",
        "100.0 GB",
        "would work",
    ):
        assert part in text
    assert "error" not in text


def test_a_machine_on_which_nothing_renders_is_not_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        gl_process, "PROBE_COMMAND", (sys.executable, "-S", "-c", "raise SystemExit('no GL')")
    )
    report = run_doctor(["cartpole"])
    assert not report.ok
    for part in ("No GL backend renders", "no GL", "apt-get install", "would not work"):
        assert part in report.text()


def test_one_backend_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    code = f"import os\nif os.environ['MUJOCO_GL'] == 'egl': raise SystemExit('no EGL')\n{PROBE}"
    monkeypatch.setattr(gl_process, "PROBE_COMMAND", (sys.executable, "-S", "-c", code))
    report = run_doctor(["cartpole"])
    assert report.ok
    assert [check.is_chosen for check in report.backends] == [False, True]
    assert "no EGL" in report.text()


def test_a_hung_backend_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import time; time.sleep(600)"
    monkeypatch.setattr(gl_process, "PROBE_COMMAND", (sys.executable, "-S", "-c", code))
    report = run_doctor(["cartpole"], backends=["egl"], timeout_s=0.5)
    assert not report.ok
    assert "did not arrive within 0.5 s" in report.text()


def test_the_users_mujoco_gl_is_the_one_that_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    os.environ["MUJOCO_GL"] = "osmesa"
    assert [check.backend for check in run_doctor(["cartpole"]).backends if check.is_chosen] == ["osmesa"]
    code = f"import os\nif os.environ['MUJOCO_GL'] == 'osmesa': raise SystemExit('no OSMesa')\n{PROBE}"
    monkeypatch.setattr(gl_process, "PROBE_COMMAND", (sys.executable, "-S", "-c", code))
    report = run_doctor(["cartpole"])
    assert not report.ok
    assert "Unset MUJOCO_GL" in report.text()


def test_a_wrong_mujoco_gl_is_reported_and_not_raised() -> None:
    os.environ["MUJOCO_GL"] = "nonsense"
    report = run_doctor(["cartpole"])
    assert not report.ok
    assert "MUJOCO_GL=nonsense" in report.text()


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"alive": False}, "constant or do not change"),
        ({"alive": False, "agent_step_ms": None, "reset_ms": None, "error": "boom"}, "boom"),
    ],
)
def test_dead_pixels_are_not_ok(
    monkeypatch: pytest.MonkeyPatch, entry: dict[str, object], words: str
) -> None:
    monkeypatch.setattr(render_check, "render_domains", lambda *_: ({**ALIVE, **entry},))
    report = run_doctor(["cartpole"])
    assert not report.ok
    assert words in report.text()


def test_what_a_world_lacks_is_not_blamed_on_the_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = {"alive": False, "agent_step_ms": None, "reset_ms": None, "error": "No module named 'pygame'"}
    for is_drawing in (True, False):
        entry = {**ALIVE, **failed, "is_drawing": is_drawing}
        monkeypatch.setattr(render_check, "render_domains", lambda *_, entry=entry: (entry,))
        assert ("Try another backend" in run_doctor(["cartpole"]).text()) == is_drawing


def test_letters_are_domains_and_unknown_names_are_refused_before_anything_is_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []
    monkeypatch.setattr(render_check, "render_domains", lambda names, *_: asked.append(names) or ())
    run_doctor(["D"])
    assert set(asked) == {("walker", "pendulum", "hopper")}
    with pytest.raises(UnknownNameError, match="walkr"):
        run_doctor(["walkr"])


def test_a_backend_that_there_is_not_is_an_error_with_its_name() -> None:
    report = run_doctor(["cartpole"], backends=["vulkan"])
    assert not report.ok
    assert "vulkan is not a GL backend" in report.text()


def test_a_backend_that_mujoco_gl_names_and_nobody_tried_is_not_ok() -> None:
    os.environ["MUJOCO_GL"] = "egl"
    report = run_doctor(["cartpole"], backends=["osmesa"])
    assert not report.ok
    assert not any(check.is_chosen for check in report.backends)
    assert "A run would use egl, which MUJOCO_GL names, but only osmesa was tried." in report.text()


def test_a_gpu_that_torch_cannot_use_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = {
        "cpu": "x",
        "cpu_instructions": "AVX2",
        "cpu_cores": 2,
        "ram_bytes": 16e9,
        "gpus": ["unusable: driver too old"],
    }
    monkeypatch.setattr(doctor.cards, "hardware", lambda: machine)
    report = run_doctor(["cartpole"])
    assert report.ok
    assert "warning: torch cannot use a GPU: unusable: driver too old." in report.text()


@pytest.mark.parametrize(
    ("ram", "disk", "severity"),
    [(16e9, 0.1e9, "error"), (16e9, 3e9, "warning"), (1e9, 100e9, "error"), (3e9, 100e9, "warning")],
)
def test_little_memory_or_disk_is_reported(
    monkeypatch: pytest.MonkeyPatch, ram: float, disk: float, severity: str
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=disk))
    monkeypatch.setattr(doctor.psutil, "virtual_memory", lambda: SimpleNamespace(available=ram, total=ram))
    report = run_doctor(["cartpole"])
    assert report.findings[0].severity == severity
    assert report.findings[0].remedy
    assert report.ok == (severity == "warning")


def test_a_software_renderer_beside_a_gpu_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = {
        "cpu": "x",
        "cpu_instructions": "AVX2",
        "cpu_cores": 2,
        "ram_bytes": 16e9,
        "gpus": ["Some GPU"],
    }
    monkeypatch.setattr(doctor.cards, "hardware", lambda: machine)
    report = run_doctor(["cartpole"])
    assert report.ok
    assert "renders in software" in report.text()
    assert "Some GPU" in report.text()


def test_versions_in_range_are_no_findings() -> None:
    assert (
        check_versions({"mujoco": "3.17.0", "torch": "2.13.0+cpu"}, ["mujoco>=3.17,<4", "torch>=2.11"]) == []
    )


@pytest.mark.parametrize(
    ("installed", "severity", "words"),
    [
        ({"mujoco": "4.0.0"}, "error", "mujoco 4.0.0"),
        ({}, "error", "not installed"),
        ({"mujoco": "3.17.0", "mujoco-core": "4.0.0"}, "warning", "mujoco-core"),
    ],
)
def test_a_breaking_mujoco_is_reported_with_its_remedy(
    installed: dict[str, str], severity: str, words: str
) -> None:
    (finding,) = check_versions(installed, ["mujoco>=3.17,<4"])
    assert finding.severity == severity
    assert words in finding.what
    assert "pip" in finding.remedy


def test_an_untested_torch_is_only_a_warning() -> None:
    (finding,) = check_versions({"torch": "2.20.0"}, ["torch>=2.11,<2.14"])
    assert finding.severity == "warning"


@pytest.mark.gl
def test_a_real_domain_is_rendered_and_timed_in_its_own_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    from crptpro.envs.rendering import select_backend

    report = run_doctor(["cartpole"], backends=[select_backend()])
    (check,) = report.backends
    (entry,) = check.domains
    assert entry["alive"]
    assert entry["agent_step_ms"] > 0
    assert check.gl["gl_renderer"] in report.text()

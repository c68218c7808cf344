from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest

from crptpro.envs import rendering
from crptpro.envs.rendering import CHECK_VARIABLE, TIMEOUT_VARIABLE, backend_card, first_frame_watchdog, select_backend
from crptpro.errors import RenderingError

LLVMPIPE = {"gl_vendor": "Mesa", "gl_renderer": "llvmpipe", "gl_version": "4.5", "gl_kind": "software", "alive": True}
CLEARED = ("MUJOCO_GL", "MUJOCO_EGL_DEVICE_ID", CHECK_VARIABLE, "LP_NUM_THREADS", "DISPLAY", "WAYLAND_DISPLAY")


def answer(**changes: object) -> str:
    return f"print({json.dumps(json.dumps({**LLVMPIPE, **changes}))})"


ANSWER = answer()
Probe = Callable[[str], Callable[[], list[str]]]


@pytest.fixture(autouse=True)
def _no_backend_yet(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(rendering, "_imported_backend", lambda: None)
    with mock.patch.dict(os.environ):
        for name in CLEARED:
            os.environ.pop(name, None)
        yield


@pytest.fixture
def probe(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Probe:
    """Replace the program that renders; what is returned tells the backend of every start."""
    record = tmp_path / "started"
    record.touch()

    def install(code: str) -> Callable[[], list[str]]:
        prelude = f"import os, sys, time; b = os.environ['MUJOCO_GL']; open({str(record)!r}, 'a').write(b + ' ')\n"
        monkeypatch.setattr(rendering, "PROBE_COMMAND", (sys.executable, "-S", "-c", prelude + code))
        return lambda: record.read_text().split()

    return install


def test_the_first_backend_that_renders_is_taken_and_checked_once_for_child_processes_too(probe: Probe) -> None:
    started = probe(ANSWER)
    assert select_backend() == select_backend() == os.environ["MUJOCO_GL"] == "egl"
    assert started() == ["egl"]
    described = {key: value for key, value in LLVMPIPE.items() if key != "alive"}
    assert backend_card() == {"backend": "egl", **described}


def test_a_check_does_not_hold_on_another_machine_or_gpu(probe: Probe, monkeypatch: pytest.MonkeyPatch) -> None:
    started = probe(ANSWER)
    select_backend()
    os.environ["MUJOCO_EGL_DEVICE_ID"] = "1"
    select_backend()
    select_backend()
    assert started() == ["egl", "egl"]
    # The environment reaches a machine without EGL, with the MUJOCO_GL=egl that was chosen here, not by the user.
    monkeypatch.setattr(rendering.socket, "gethostname", lambda: "node-7")
    probe(f"if b == 'egl': sys.exit('no EGL')\n{ANSWER}")
    assert select_backend() == "osmesa"
    assert started() == ["egl", "egl", "egl", "osmesa"]


@pytest.mark.parametrize("spelling", ["osmesa", "OSMesa"])
def test_a_users_mujoco_gl_is_kept_and_checked(probe: Probe, spelling: str) -> None:
    os.environ["MUJOCO_GL"] = spelling
    started = probe(ANSWER)
    assert select_backend() == "osmesa"
    assert os.environ["MUJOCO_GL"] == "osmesa", "as every library understands it"
    assert started() == ["osmesa"]


@pytest.mark.parametrize(
    ("environment", "code", "complaint", "tried"),
    [
        # A user's choice is kept even if it does not render.
        ({"MUJOCO_GL": "egl"}, "sys.exit('no EGL display')", r"=egl was set by you.*\n.*no EGL display", ["egl"]),
        ({"MUJOCO_GL": "nonsense"}, ANSWER, r"MUJOCO_GL=nonsense .*egl.*osmesa.*glfw", []),
        ({"MUJOCO_GL": "off"}, ANSWER, "MUJOCO_GL=off is not a GL backend", []),
        # When nothing renders every reason is given; GLFW is only tried with a display.
        ({}, "sys.exit(f'{b} is broken')", r"(?s)No GL.*egl is broken.*osmesa is broken", ["egl", "osmesa"]),
        ({"DISPLAY": ":0"}, "sys.exit(1)", "glfw", ["egl", "osmesa", "glfw"]),
        # A driver that crashes or draws nothing is no proof.
        ({"MUJOCO_GL": "egl"}, "os.kill(os.getpid(), 11)", "SIGSEGV.*apt-get install libegl1", ["egl"]),
        ({"MUJOCO_GL": "egl"}, answer(alive=False), "without content.*apt-get install libegl1", ["egl"]),
        ({"MUJOCO_GL": "egl"}, "print('hello')", "gave no answer.*apt-get install libegl1", ["egl"]),
        ({"MUJOCO_GL": "egl"}, "sys.exit(3)", "exit status 3.*apt-get install libegl1", ["egl"]),
    ],
)
def test_what_does_not_render_is_one_error_that_says_why(
    probe: Probe, environment: dict[str, str], code: str, complaint: str, tried: list[str]
) -> None:
    os.environ.update(environment)
    started = probe(code)
    with pytest.raises(RenderingError, match=complaint):
        select_backend()
    assert started() == tried
    assert os.environ.get("MUJOCO_GL") == environment.get("MUJOCO_GL")


def test_a_hung_first_frame_is_ended_and_named_with_cause_and_remedies(probe: Probe, tmp_path: Path) -> None:
    os.environ["MUJOCO_GL"] = "egl"
    probe(f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(600)")
    start = time.monotonic()
    os.environ[TIMEOUT_VARIABLE] = "3"
    with pytest.raises(RenderingError) as caught:
        select_backend()
    assert time.monotonic() - start < 30
    for part in ("did not arrive within 3 s", "several processes hold EGL contexts", "MUJOCO_GL=osmesa"):
        assert part in str(caught.value)
    assert not Path(f"/proc/{(tmp_path / 'pid').read_text()}").exists()


def test_a_backend_that_fails_gives_way_and_is_not_tried_again(probe: Probe, caplog: pytest.LogCaptureFixture) -> None:
    started = probe(f"if b == 'egl': sys.exit('ImportError: no libEGL')\n{ANSWER}")
    with caplog.at_level(logging.WARNING):
        assert select_backend() == "osmesa"
    assert "egl: ImportError: no libEGL. Install EGL (Debian, Ubuntu: apt-get install libegl1" in caplog.text
    assert select_backend(processes=2) == "osmesa"
    assert started() == ["egl", "osmesa", "osmesa", "osmesa"]


def test_several_processes_are_checked_at_the_same_time(probe: Probe, tmp_path: Path) -> None:
    # Each waits until all three have started, so only simultaneous processes can answer.
    record = str(tmp_path / "started")
    started = probe(f"while len(open({record!r}).read().split()) < 3: time.sleep(0.01)\n{ANSWER}")
    os.environ[TIMEOUT_VARIABLE] = "20"
    assert select_backend(processes=3) == "egl"
    assert select_backend(processes=2) == "egl"
    assert len(started()) == 3


def test_a_backend_that_dm_control_was_imported_with_is_said(probe: Probe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "_imported_backend", lambda: "glfw")
    probe("sys.exit('no display')")
    with pytest.raises(RenderingError, match=r"(?s)imported with the backend 'glfw' before.*no display"):
        select_backend()
    os.environ["MUJOCO_GL"] = "egl"
    with pytest.raises(RenderingError, match="already imported with the backend 'glfw'"):
        select_backend()


@pytest.mark.parametrize(
    ("kind", "threads", "expected"), [("software", None, "1"), ("software", "4", "4"), ("hardware", None, None)]
)
def test_software_gl_takes_one_thread(probe: Probe, kind: str, threads: str | None, expected: str | None) -> None:
    probe(answer(gl_kind=kind))
    os.environ.update({} if threads is None else {"LP_NUM_THREADS": threads})
    select_backend()
    assert os.environ.get("LP_NUM_THREADS") == expected


def test_the_watchdog_names_a_slow_first_frame_and_no_quick_one(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        with first_frame_watchdog():
            pass
        assert not caplog.records
        os.environ[TIMEOUT_VARIABLE] = "0.05"
        with first_frame_watchdog():
            time.sleep(0.3)
    assert "first frame" in caplog.text
    assert "MUJOCO_GL=osmesa" in caplog.text


def test_an_empty_mujoco_gl_is_none(probe: Probe) -> None:
    os.environ["MUJOCO_GL"] = ""
    started = probe(f"if b == 'egl': sys.exit('no EGL')\n{ANSWER}")
    assert select_backend() == os.environ["MUJOCO_GL"] == "osmesa"
    assert started() == ["egl", "osmesa"]


@pytest.mark.parametrize(("backend", "is_loaded"), [("nonsense", False), ("egl", True)])
def test_a_backend_that_cannot_be_loaded_stops_nothing_but_rendering(backend: str, is_loaded: bool) -> None:
    """MuJoCo, which TorchRL imports, fails at its import."""
    code = "import crptpro.data, mujoco, os; print(os.environ['MUJOCO_GL'], hasattr(mujoco, 'GLContext'))"
    environment = {**os.environ, "MUJOCO_GL": backend}
    ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, f"{backend} {is_loaded}\n", "")


def test_a_command_that_renders_says_in_one_line_that_mujoco_gl_is_wrong(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "crptpro", "collect", "pendulum", "--out", str(tmp_path)]
    environment = {**os.environ, "MUJOCO_GL": "nonsense"}
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    (line,) = [line for line in ran.stderr.splitlines() if "MUJOCO_GL" in line]
    assert "MUJOCO_GL=nonsense is not a GL backend. Set it to egl" in line
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize("text", ["inf", "nan", "0", "-1", "1e300", "soon"])
def test_a_time_limit_that_cannot_be_is_refused(text: str) -> None:
    os.environ[TIMEOUT_VARIABLE] = text
    with pytest.raises(RenderingError, match=f"CRPTPRO_GL_TIMEOUT_S must be a positive number .* got '{text}'"):
        rendering.first_frame_timeout_s()

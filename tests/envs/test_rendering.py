from __future__ import annotations

import importlib
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest

import crptpro.envs
from crptpro.envs import rendering
from crptpro.envs.rendering import PROOF_VARIABLE, backend_card, first_frame_watchdog, select_backend
from crptpro.errors import RenderingError

LLVMPIPE = {
    "gl_vendor": "Mesa", "gl_renderer": "llvmpipe", "gl_version": "4.5", "gl_kind": "software", "alive": True,
}  # fmt: skip
ANSWER = f"print({json.dumps(json.dumps(LLVMPIPE))})"

Probe = Callable[[str], Path]


@pytest.fixture(autouse=True)
def _no_backend_yet(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(rendering, "_imported_backend", lambda: None)
    with mock.patch.dict(os.environ):
        for name in (
            "MUJOCO_GL",
            "MUJOCO_EGL_DEVICE_ID",
            PROOF_VARIABLE,
            "LP_NUM_THREADS",
            "DISPLAY",
            "WAYLAND_DISPLAY",
        ):
            os.environ.pop(name, None)
        yield


@pytest.fixture
def probe(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Probe:
    """Replace the program that renders; the returned file records the backend of every start."""
    record = tmp_path / "started"

    def install(code: str) -> Path:
        prelude = (
            f"import os, sys, time; b = os.environ['MUJOCO_GL']; open({str(record)!r}, 'a').write(b + ' ')\n"
        )
        command = (sys.executable, "-S", "-c", prelude + code)
        monkeypatch.setattr(rendering, "PROBE_COMMAND", command)
        return record

    return install


def test_the_first_backend_that_renders_is_taken_and_proven_once_for_child_processes_too(
    probe: Probe,
) -> None:
    started = probe(ANSWER)
    assert select_backend() == select_backend() == os.environ["MUJOCO_GL"] == "egl"
    assert started.read_text().split() == ["egl"]
    assert json.loads(os.environ[PROOF_VARIABLE])["gl_renderer"] == "llvmpipe"
    described = {key: value for key, value in LLVMPIPE.items() if key != "alive"}
    assert backend_card() == {"backend": "egl", **described}


def test_a_proof_does_not_hold_on_another_machine_or_gpu(
    probe: Probe, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = probe(ANSWER)
    select_backend()
    os.environ["MUJOCO_EGL_DEVICE_ID"] = "1"
    select_backend()
    select_backend()
    assert started.read_text().split() == ["egl", "egl"]
    # The environment reaches a machine without EGL, with the MUJOCO_GL=egl that was chosen here, not by the user.
    monkeypatch.setattr(rendering.socket, "gethostname", lambda: "node-7")
    started = probe(f"if b == 'egl': sys.exit('no EGL')\n{ANSWER}")
    assert select_backend() == "osmesa"
    assert started.read_text().split() == ["egl", "egl", "egl", "osmesa"]
    assert json.loads(os.environ[PROOF_VARIABLE])["host"] == "node-7"


@pytest.mark.parametrize("spelling", ["osmesa", "OSMesa"])
def test_a_users_mujoco_gl_is_kept_and_proven(
    probe: Probe, spelling: str, caplog: pytest.LogCaptureFixture
) -> None:
    os.environ["MUJOCO_GL"] = spelling
    started = probe(ANSWER)
    with caplog.at_level(logging.WARNING):
        assert select_backend() == "osmesa"
    assert os.environ["MUJOCO_GL"] == "osmesa", "as every library understands it"
    assert started.read_text().split() == ["osmesa"]


def test_a_users_mujoco_gl_is_kept_even_if_it_does_not_render(probe: Probe) -> None:
    os.environ["MUJOCO_GL"] = "egl"
    started = probe("sys.exit(ANSWER if b == 'osmesa' else 'no EGL display')")
    with pytest.raises(RenderingError, match=r"MUJOCO_GL=egl was set by you.*\n.*no EGL display"):
        select_backend()
    assert started.read_text().split() == ["egl"]
    assert os.environ["MUJOCO_GL"] == "egl"


@pytest.mark.parametrize(
    ("value", "complaint"),
    [("nonsense", r"MUJOCO_GL=nonsense .*egl.*osmesa.*glfw"), ("off", "switches rendering off")],
)
def test_a_value_that_cannot_render_is_one_clear_error_and_starts_nothing(
    probe: Probe, value: str, complaint: str
) -> None:
    os.environ["MUJOCO_GL"] = value
    started = probe(ANSWER)
    with pytest.raises(RenderingError, match=complaint):
        select_backend()
    assert not started.exists()


def test_the_next_backend_is_taken_and_the_failure_of_the_first_is_said(
    probe: Probe, caplog: pytest.LogCaptureFixture
) -> None:
    probe(f"if b == 'egl': sys.exit('ImportError: no libEGL')\n{ANSWER}")
    with caplog.at_level(logging.WARNING):
        assert select_backend() == "osmesa"
    assert "no libEGL" in caplog.text
    assert "apt-get install libegl1" in caplog.text


def test_when_nothing_renders_every_reason_is_given(probe: Probe) -> None:
    probe("sys.exit(f'{b} is broken')")
    with pytest.raises(RenderingError, match=r"(?s)No GL backend.*egl is broken.*osmesa is broken"):
        select_backend()


def test_glfw_is_only_tried_with_a_display(probe: Probe) -> None:
    os.environ["DISPLAY"] = ":0"
    started = probe("sys.exit(1)")
    with pytest.raises(RenderingError):
        select_backend()
    assert started.read_text().split() == ["egl", "osmesa", "glfw"]


def test_a_hung_first_frame_is_ended_and_named_with_its_cause_and_the_alternatives(
    probe: Probe, tmp_path: Path
) -> None:
    os.environ["MUJOCO_GL"] = "egl"
    probe(f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(600)")
    start = time.monotonic()
    with pytest.raises(RenderingError) as caught:
        select_backend(timeout_s=4.0)
    assert time.monotonic() - start < 30
    for part in ("did not arrive within 4 s", "several processes hold EGL contexts", "MUJOCO_GL=osmesa"):
        assert part in str(caught.value)
    assert not Path(f"/proc/{(tmp_path / 'pid').read_text()}").exists()


def test_a_backend_that_hangs_gives_way_to_one_that_renders(
    probe: Probe, caplog: pytest.LogCaptureFixture
) -> None:
    started = probe(f"if b == 'egl': time.sleep(600)\n{ANSWER}")
    with caplog.at_level(logging.WARNING):
        assert select_backend(timeout_s=4.0) == "osmesa"
    assert "egl: the first frame did not arrive" in caplog.text
    assert select_backend(timeout_s=4.0, processes=2) == "osmesa"
    assert started.read_text().split() == ["egl", "osmesa", "osmesa", "osmesa"], (
        "the hang was waited for twice"
    )


def test_the_time_limit_can_be_set_from_outside(probe: Probe) -> None:
    probe("time.sleep(600)")
    os.environ.update({"MUJOCO_GL": "osmesa", rendering.TIMEOUT_VARIABLE: "0.2"})
    with pytest.raises(RenderingError, match=r"within 0\.2 s"):
        select_backend()
    os.environ[rendering.TIMEOUT_VARIABLE] = "soon"
    with pytest.raises(RenderingError, match="'soon'"):
        select_backend()


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("os.kill(os.getpid(), 11)", "SIGSEGV"),
        (f"print({json.dumps(json.dumps({**LLVMPIPE, 'alive': False}))})", "without content"),
        ("print('hello')", "gave no answer"),
        ("sys.exit(3)", "exit status 3"),
    ],
)
def test_a_driver_that_crashes_or_draws_nothing_is_no_proof(probe: Probe, code: str, reason: str) -> None:
    os.environ["MUJOCO_GL"] = "egl"
    probe(code)
    with pytest.raises(RenderingError, match=rf"{reason}.*apt-get install libegl1"):
        select_backend()


def test_several_processes_are_proven_at_the_same_time(probe: Probe, tmp_path: Path) -> None:
    # Each waits until all three have started, so only simultaneous processes can answer.
    started = probe(
        f"while len(open({str(tmp_path / 'started')!r}).read().split()) < 3: time.sleep(0.01)\n{ANSWER}"
    )
    assert select_backend(processes=3, timeout_s=20) == "egl"
    assert select_backend(processes=2) == "egl"
    assert len(started.read_text().split()) == 3


def test_a_backend_that_dm_control_was_imported_with_is_said(
    probe: Probe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "_imported_backend", lambda: "glfw")
    probe("sys.exit('no display')")
    with pytest.raises(RenderingError, match=r"(?s)imported with the backend 'glfw' before.*no display"):
        select_backend()
    os.environ["MUJOCO_GL"] = "egl"
    with pytest.raises(RenderingError, match="already imported with the backend 'glfw'"):
        select_backend()


@pytest.mark.parametrize(
    ("kind", "threads", "expected"),
    [("software", None, "1"), ("software", "4", "4"), ("hardware", None, None)],
)
def test_software_gl_gets_one_thread_unless_the_user_says_otherwise(
    probe: Probe, kind: str, threads: str | None, expected: str | None
) -> None:
    probe(f"print({json.dumps(json.dumps({**LLVMPIPE, 'gl_kind': kind}))})")
    os.environ.update({} if threads is None else {"LP_NUM_THREADS": threads})
    select_backend()
    assert os.environ.get("LP_NUM_THREADS") == expected


def test_the_watchdog_names_a_slow_first_frame_and_is_silent_about_a_quick_one(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.ERROR):
        with first_frame_watchdog(timeout_s=30):
            pass
        assert not caplog.records
        with first_frame_watchdog(timeout_s=0.05):
            time.sleep(0.3)
    assert "first frame" in caplog.text
    assert "MUJOCO_GL=osmesa" in caplog.text


@pytest.mark.gl
def test_a_real_backend_renders_and_describes_itself() -> None:
    backend = select_backend()
    card = backend_card()
    assert card["backend"] == backend
    assert card["gl_vendor"] not in ("", "unknown")
    assert card["gl_kind"] in ("software", "hardware")


def test_a_backend_that_cannot_be_loaded_is_one_error_that_names_the_remedy_at_the_import(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    os.environ["MUJOCO_GL"] = "osmesa"
    monkeypatch.setitem(sys.modules, "torchrl.envs", None)  # makes its import fail, as MuJoCo's failure does
    with pytest.raises(RenderingError, match=r"MUJOCO_GL=osmesa is set, and cannot be loaded.*libosmesa6"):
        importlib.reload(crptpro.envs)

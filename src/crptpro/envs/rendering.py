"""The GL backend: chosen once, tested by a frame under a time limit, recorded in every card."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from crptpro.errors import RenderingError

logger = logging.getLogger(__name__)

BACKENDS = ("egl", "osmesa", "glfw")
#: Environment variable with the passed test as JSON, for later calls and child processes. A cluster may copy the
#: environment to another machine, where the test does not count.
CHECK_VARIABLE = "CRPTPRO_GL_CHECK"
#: Environment variable with the time limit of a first frame in seconds, for slow disks and busy machines.
TIMEOUT_VARIABLE = "CRPTPRO_GL_TIMEOUT_S"

HANG = (
    "The usual cause is a GPU driver that hangs when several processes hold EGL contexts at once (NVIDIA 580.x does, "
    "google-deepmind/mujoco issue 3444), or a context that a killed run left. Alternatives: MUJOCO_GL=osmesa "
    "(software, no GPU driver involved), MUJOCO_EGL_DEVICE_ID=<number> (another GPU), fewer worker processes, or a "
    f"longer {TIMEOUT_VARIABLE} on a slow machine."
)
REMEDIES = {
    "egl": "Install EGL (Debian, Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri), or "
    "the GL parts of the GPU's driver.",
    "osmesa": "Install OSMesa (Debian 12, Ubuntu: apt-get install libosmesa6).",
    "glfw": "GLFW needs a display; on a machine without one use MUJOCO_GL=egl or MUJOCO_GL=osmesa.",
}

#: Renders one small scene with the backend of MUJOCO_GL and describes it as JSON. It runs in a separate process,
#: because a broken GL driver may hang or crash, and imports MuJoCo alone, to take a second or two.
_PROBE = """
import importlib, json, os
import mujoco
if not hasattr(mujoco, "Renderer"):  # MuJoCo hides why its backend cannot be imported
    importlib.import_module("mujoco." + os.environ["MUJOCO_GL"])
model = mujoco.MjModel.from_xml_string('''<mujoco><visual><quality shadowsize="512"/></visual><worldbody>
    <light pos="0 0 3"/><geom type="plane" size="2 2 .1" rgba="1 0 0 1"/><geom type="sphere" size=".4" pos="0 0 .4"/>
    <camera name="c" pos="0 -2 2" xyaxes="1 0 0 0 .7 .7"/></worldbody></mujoco>''')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 84, 84)
renderer.update_scene(data, camera="c")
first = renderer.render().copy()
again = renderer.render()
from OpenGL import GL
names = {"gl_vendor": GL.GL_VENDOR, "gl_renderer": GL.GL_RENDERER, "gl_version": GL.GL_VERSION}
answer = {key: (GL.glGetString(name) or b"unknown").decode(errors="replace") for key, name in names.items()}
soft = any(name in answer["gl_renderer"].lower() for name in ("llvmpipe", "softpipe", "swrast", "software"))
answer["gl_kind"] = "software" if soft else "hardware"
answer["alive"] = bool(first.max() > first.min() and (first == again).all())
renderer.close()
print(json.dumps(answer))
"""
PROBE_COMMAND = (sys.executable, "-c", _PROBE)


def select_backend(*, processes: int = 1) -> str:
    """Choose the GL backend, test that it renders, and set ``MUJOCO_GL``; call it before importing dm_control.

    A user's ``MUJOCO_GL`` is tested and kept. Otherwise EGL, OSMesa and (with a display) GLFW are tried in this
    order. The test is a frame with content from each of ``processes`` simultaneous processes (parallel collection needs
    several), by default within 60 s. It counts for this process and its children, on this machine and for one
    ``MUJOCO_EGL_DEVICE_ID``. With software GL, ``LP_NUM_THREADS=1`` is set unless the user has set it: more threads
    cost a third more CPU time per frame and save hardly any time. If no backend renders, a ``RenderingError`` names
    cause and remedy for each.
    """
    timeout_s = first_frame_timeout_s()
    checked = _checked()
    requested, imported = _requested_backend(checked), _imported_backend()
    if imported is not None and requested not in (None, imported):
        raise RenderingError(
            f"dm_control was already imported with the backend {imported!r}, so {requested!r} cannot be used in this "
            f"process any more. Set MUJOCO_GL={requested} before importing dm_control."
        )
    only = requested or imported
    candidates = (only,) if only else _platform_candidates()
    place = {"host": socket.gethostname(), "egl_device": os.environ.get("MUJOCO_EGL_DEVICE_ID")}
    if checked.get("backend") in candidates and checked.items() >= place.items():
        if checked["processes"] >= processes:
            os.environ["MUJOCO_GL"] = checked["backend"]
            return checked["backend"]
        candidates = candidates[candidates.index(checked["backend"]) :]  # those before it have failed already
    failures: list[str] = []
    for backend in candidates:
        try:
            gl = _check(backend, timeout_s, processes)
        except RenderingError as reason:
            failures.append(str(reason))
            continue
        for failure in failures:
            logger.warning("%s Rendering with %s instead.", failure, backend)
        os.environ["MUJOCO_GL"] = backend  # in the spelling that dm_control and Gymnasium both accept
        if gl["gl_kind"] == "software":
            os.environ.setdefault("LP_NUM_THREADS", "1")
        gl |= {"backend": backend, "processes": processes, "chosen_by": "user" if requested else "crptpro"}
        os.environ[CHECK_VARIABLE] = json.dumps(gl | place)
        logger.info("GL backend %s: %s", backend, gl["gl_renderer"])
        return backend
    what = "No GL backend renders a frame."
    if requested:
        what = f"MUJOCO_GL={os.environ['MUJOCO_GL']} was set by you, is kept, and does not render a frame."
    elif imported:
        what = (
            f"dm_control was imported with the backend {imported!r} before one could be chosen, and it does not "
            "render a frame. Make the first environment before importing dm_control, or set MUJOCO_GL."
        )
    raise RenderingError("\n  ".join([what, *failures]))


def backend_card() -> dict[str, Any]:
    """Return the tested backend, the GL vendor, renderer and version, and whether GL is software or hardware."""
    keys = ("backend", "gl_vendor", "gl_renderer", "gl_version", "gl_kind")
    return {key: _checked().get(key, "unknown") for key in keys}


@contextlib.contextmanager
def first_frame_watchdog() -> Iterator[None]:
    """Log an error with the likely cause if the body, which renders a first frame, does not return in time.

    Python cannot interrupt a call that hangs in the driver: the process stays, and its parent should end it.
    """
    timeout_s = first_frame_timeout_s()
    message = f"Process {os.getpid()} has waited {timeout_s:g} s for its first frame. {HANG}"
    timer = threading.Timer(timeout_s, logger.error, args=(message,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextlib.contextmanager
def render_context(make_current: Callable[[], Any] | None, *, is_first: bool = False) -> Iterator[None]:
    """Make a render context current in the body and none after it, because the contexts of a thread interfere.

    Freeing an environment frees its textures in whichever context is current, and then detaches that from the thread:
    later frames of another environment would be black. The garbage collector, which may free one at any moment, is off
    in the body. ``make_current`` is ``None`` before the context exists. The watchdog runs if the body ``is_first``.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        with first_frame_watchdog() if is_first else contextlib.nullcontext():
            if make_current is not None:
                make_current()
            yield
    finally:
        _leave_none_current()
        if collects:
            gc.enable()


def _leave_none_current() -> None:
    backend = os.environ.get("MUJOCO_GL")
    if backend == "egl" and (egl := sys.modules.get("OpenGL.EGL")) is not None:
        # Not eglReleaseThread: on an NVIDIA driver 12 processes that called it after every image made 2 agent steps/s
        # each, and 114 this way.
        egl.eglBindAPI(egl.EGL_OPENGL_API)  # the API of a thread decides which context it loses
        if display := egl.eglGetCurrentDisplay():
            egl.eglMakeCurrent(display, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
    elif backend == "glfw" and (glfw := sys.modules.get("glfw")) is not None:
        glfw.make_context_current(None)
    elif backend == "osmesa" and (osmesa := sys.modules.get("OpenGL.osmesa")) is not None:
        osmesa.OSMesaMakeCurrent(None, None, 0x1406, 0, 0)  # GL_FLOAT


def first_frame_timeout_s() -> float:
    """Return ``CRPTPRO_GL_TIMEOUT_S``, by default 60."""
    text = os.environ.get(TIMEOUT_VARIABLE, "60")
    with contextlib.suppress(ValueError):
        if 0 < (seconds := float(text)) <= threading.TIMEOUT_MAX:
            return seconds
    raise RenderingError(f"{TIMEOUT_VARIABLE} must be a positive number of seconds, got {text!r}.")


def run_isolated(
    commands: list[tuple[str, ...]], backend: str | None, *, timeout_s: float
) -> list[tuple[int | None, str, str]]:
    """Run commands simultaneously with ``MUJOCO_GL=backend`` if given, and kill those that exceed the time limit.

    Returns exit status (``None``: killed), standard output and standard error of each. Output goes to files, not pipes,
    and a killed process is waited for only briefly, because one that hangs in the kernel cannot be reaped.
    """
    environment = {**os.environ, **({"MUJOCO_GL": backend} if backend else {})}
    if "OpenGL" in sys.modules:  # dm_control or mujoco has set it for the backend of this process
        environment.pop("PYOPENGL_PLATFORM", None)
    results: list[tuple[int | None, str, str]] = []
    with contextlib.ExitStack() as stack:
        jobs = []
        for command in commands:
            out, err = (stack.enter_context(tempfile.TemporaryFile("w+", errors="replace")) for _ in range(2))
            process = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True
            )
            stack.callback(_kill, process)
            jobs.append((process, out, err))
        deadline = time.monotonic() + timeout_s
        for process, out, err in jobs:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))
            out.seek(0)
            err.seek(0)
            results.append((process.returncode, out.read(), err.read()))
    return results


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(2.0)


def _check(backend: str, timeout_s: float, processes: int) -> dict[str, Any]:
    """Render in ``processes`` simultaneous processes, and return the answer of the last probe."""
    gl: dict[str, Any] = {}
    for status, stdout, stderr in run_isolated([PROBE_COMMAND] * processes, backend, timeout_s=timeout_s):
        if status is None:
            limit = f"within {timeout_s:g} s ({processes} at the same time)"
            raise RenderingError(f"{backend}: the first frame did not arrive {limit}. {HANG}")
        answer = re.search(r'^\{"gl_.*\}$', stdout, re.MULTILINE)
        gl = json.loads(answer[0]) if answer else {}
        if status < 0:
            reason = f"the GL driver crashed the process ({signal.Signals(-status).name})"
        elif status > 0:
            lines = stderr.strip().splitlines() or [f"the probe ended with exit status {status}"]
            reason = lines[-1].strip().rstrip(".")
        elif not gl:
            reason = "the probe gave no answer"
        elif not gl["alive"]:
            reason = "the frame came back without content; the GL driver does not work"
        else:
            continue
        remedy = "Unset PYOPENGL_PLATFORM." if "PYOPENGL_PLATFORM" in reason else REMEDIES[backend]
        raise RenderingError(f"{backend}: {reason}. {remedy}")
    return gl


def _platform_candidates() -> tuple[str, ...]:
    if not sys.platform.startswith("linux"):
        return ("glfw",)
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return BACKENDS if has_display else ("egl", "osmesa")


def _requested_backend(checked: dict[str, Any]) -> str | None:
    """Return the backend of a MUJOCO_GL that the user set, and not an earlier call, perhaps on another machine."""
    text = os.environ.get("MUJOCO_GL", "")
    backend = text.strip().lower()
    if not backend or (checked.get("chosen_by") == "crptpro" and backend == checked["backend"]):
        return None
    if backend not in BACKENDS:
        raise RenderingError(
            f"MUJOCO_GL={text} is not a GL backend. Set it to egl (GPU or Mesa), osmesa (software) or glfw "
            "(needs a display), or unset it and the first that renders is taken."
        )
    return backend


def _imported_backend() -> str | None:
    name = getattr(sys.modules.get("dm_control._render"), "BACKEND", None)
    return name if name in BACKENDS else None


def _checked() -> dict[str, Any]:
    """Return the passed test, perhaps one of another machine."""
    return json.loads(os.environ.get(CHECK_VARIABLE) or "{}")

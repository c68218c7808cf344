"""Try a GL backend in a process of its own: a driver may fail, crash or hang without harm to the caller."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from crptpro.errors import RenderingError

BACKENDS = ("egl", "osmesa", "glfw")

#: The values of MUJOCO_GL that dm_control knows, with what they mean.
_SYNONYMS = {
    "egl": "egl",
    "osmesa": "osmesa",
    **dict.fromkeys(("glfw", "on", "enable", "enabled", "true", "1", ""), "glfw"),
    **dict.fromkeys(("off", "disable", "disabled", "false", "0"), "off"),
}

#: What is run, with MUJOCO_GL set, to render a frame; its standard output is JSON.
PROBE_COMMAND = (sys.executable, str(Path(__file__).with_name("gl_probe.py")))

REMEDIES = {
    "egl": "Install EGL (Debian, Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri), or "
    "the GL parts of the GPU's driver.",
    "osmesa": "Install OSMesa (Debian 12, Ubuntu: apt-get install libosmesa6).",
    "glfw": "GLFW needs a display; on a machine without one use MUJOCO_GL=egl or MUJOCO_GL=osmesa.",
}  # fmt: skip


def canonical_backend(text: str) -> str:
    """Return ``"egl"``, ``"osmesa"``, ``"glfw"`` or ``"off"`` for a value of ``MUJOCO_GL``.

    Raises:
        RenderingError: for any other value.

    Examples:
        >>> canonical_backend("EGL"), canonical_backend("disabled")
        ('egl', 'off')
    """
    backend = _SYNONYMS.get(text.strip().lower())
    if backend is None:
        raise RenderingError(
            f"MUJOCO_GL={text} is not a GL backend. Set it to egl (GPU or Mesa), osmesa (software) or glfw "
            "(needs a display), or unset it and the first that renders is taken."
        )
    return backend


@dataclass(frozen=True)
class Attempt:
    """How a backend did.

    Args:
        backend: Its name.
        is_ok: A frame with content came back, from every process.
        is_timeout: None came back in time.
        reason: What went wrong, one line.
        remedy: What to do about it, one line.
        answer: What the probe measured (GL strings, ``first_frame_s``, ``frame_ms``).
    """

    backend: str
    is_ok: bool
    is_timeout: bool = False
    reason: str = ""
    remedy: str = ""
    answer: dict[str, Any] = field(default_factory=dict)


def attempt_backend(backend: str, *, timeout_s: float, processes: int = 1) -> Attempt:
    """Render with ``backend`` in ``processes`` simultaneous processes, all within ``timeout_s``."""
    runs = run_isolated([PROBE_COMMAND] * processes, backend, timeout_s=timeout_s)
    for returncode, stdout, stderr in runs:
        if returncode is None:
            return Attempt(backend, False, is_timeout=True)
        if returncode != 0:
            reason = _last_line(stderr, returncode)
            has_conflict = "PYOPENGL_PLATFORM" in reason
            remedy = "Unset PYOPENGL_PLATFORM." if has_conflict else REMEDIES[backend]
            return Attempt(backend, False, reason=reason, remedy=remedy)
        try:
            answer = json.loads(stdout.strip().splitlines()[-1])
        except (json.JSONDecodeError, IndexError):
            return Attempt(backend, False, reason="the probe gave no answer.", remedy=REMEDIES[backend])
        if not answer.get("alive"):
            reason = "the frame came back without content; the GL driver does not work."
            return Attempt(backend, False, reason=reason, remedy=REMEDIES[backend], answer=answer)
    return Attempt(backend, True, answer=answer)


def run_isolated(
    commands: list[tuple[str, ...]], backend: str, *, timeout_s: float
) -> list[tuple[int | None, str, str]]:
    """Run commands at the same time with ``MUJOCO_GL=backend``; kill what is not done in time.

    Output goes through files, not pipes, and nobody waits for a killed process: one that hangs in the kernel
    cannot be reaped.

    Returns:
        For each command its exit status (``None``: killed), standard output and standard error.
    """
    with contextlib.ExitStack() as stack:
        jobs: list[tuple[subprocess.Popen[bytes], IO[bytes], IO[bytes]]] = []
        for command in commands:
            out: IO[bytes] = stack.enter_context(tempfile.TemporaryFile())
            err: IO[bytes] = stack.enter_context(tempfile.TemporaryFile())
            process = subprocess.Popen(
                command, env=_environment(backend), stdin=subprocess.DEVNULL, stdout=out, stderr=err,
                start_new_session=True,
            )  # fmt: skip
            jobs.append((process, out, err))
        deadline = time.monotonic() + timeout_s
        results = []
        for process, out, err in jobs:
            try:
                returncode: int | None = process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                returncode = None
            except BaseException:
                _kill([job[0] for job in jobs])
                raise
            results.append((returncode, _text(out), _text(err)))
        _kill([job[0] for job in jobs if job[0].poll() is None])
        return results


def _environment(backend: str) -> dict[str, str]:
    environment = {**os.environ, "MUJOCO_GL": backend}
    if "OpenGL" in sys.modules:  # then dm_control or mujoco has set it here, for the backend of this process
        environment.pop("PYOPENGL_PLATFORM", None)
    return environment


def _kill(processes: list[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(2.0)


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


def _last_line(stderr: str, returncode: int) -> str:
    if returncode < 0:
        return f"the GL driver crashed the process ({signal.Signals(-returncode).name})."
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    return f"{lines[-1].rstrip('.')}." if lines else f"the probe ended with exit status {returncode}."

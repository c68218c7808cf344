"""Which GL backend renders: chosen once, proven by a frame under a time limit, written into every card."""

from __future__ import annotations

import json
import logging
import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from crptpro.envs.gl_process import BACKENDS, Attempt, attempt_backend, canonical_backend
from crptpro.errors import RenderingError

logger = logging.getLogger(__name__)

#: Environment variable that carries the proof, as JSON, to this process's later calls and to its children. A cluster
#: may hand the environment on to another machine, where the proof holds no longer.
PROOF_VARIABLE = "CRPTPRO_GL_PROOF"
#: Environment variable with the seconds a first frame may take, for slow disks and busy machines.
TIMEOUT_VARIABLE = "CRPTPRO_GL_TIMEOUT_S"

ALTERNATIVES = (
    "Alternatives: MUJOCO_GL=osmesa (software, no GPU driver involved), MUJOCO_EGL_DEVICE_ID=<number> "
    f"(another GPU), fewer worker processes, or a longer {TIMEOUT_VARIABLE} on a machine that is merely slow."
)
HANG_CAUSE = (
    "The usual cause is a GPU driver that hangs when several processes hold EGL contexts at once (NVIDIA "
    "580.x does, google-deepmind/mujoco issue 3444), or one left behind by a killed run."
)


def select_backend(
    preference: str | None = None, timeout_s: float | None = None, *, processes: int = 1
) -> str:
    """Choose the GL backend, prove that it renders, set ``MUJOCO_GL``; call it before importing dm_control.

    A ``MUJOCO_GL`` that the user has set is never overridden, only proven. Otherwise ``preference`` is
    taken, or EGL, OSMesa and (with a display) GLFW are tried in this order. The proof is a frame with
    content, rendered in a process of its own within the time limit. It holds for this process and its
    children, on this machine and for one ``MUJOCO_EGL_DEVICE_ID``, so it is made once. With software GL,
    ``LP_NUM_THREADS=1`` is set unless the user has set it: more threads cost a third more CPU time per frame
    and hardly gain any.

    Args:
        preference: ``"egl"``, ``"osmesa"`` or ``"glfw"``.
        timeout_s: Seconds each backend has for its first frame; by default 60, or ``CRPTPRO_GL_TIMEOUT_S``.
        processes: Prove that so many processes can render at the same time, as parallel collection needs.

    Returns:
        ``"egl"``, ``"osmesa"`` or ``"glfw"``.

    Raises:
        RenderingError: naming, for every backend tried, what went wrong and what to do.
    """
    timeout_s = default_timeout_s() if timeout_s is None else timeout_s
    proof = _proof()
    requested = _requested_by_user()
    if preference is not None and preference not in BACKENDS:
        raise RenderingError(f"There is no GL backend {preference!r}; choose one of {', '.join(BACKENDS)}.")
    if requested is not None and preference not in (None, requested):
        logger.warning("MUJOCO_GL=%s is set and kept; %s is not used.", requested, preference)
    wanted = requested or preference
    imported = _imported_backend()
    if imported is not None and wanted not in (None, imported):
        raise RenderingError(
            f"dm_control was already imported with the backend {imported!r}, so {wanted!r} cannot be used in "
            f"this process any more. Set MUJOCO_GL={wanted}, or make the first environment, before "
            "importing dm_control."
        )
    only = wanted or imported
    candidates = (only,) if only else platform_candidates()
    if proof and proof["processes"] >= processes and proof["backend"] in candidates:
        os.environ["MUJOCO_GL"] = proof["backend"]
        return proof["backend"]
    if proof and proof["backend"] in candidates:  # those before it have failed already
        candidates = candidates[candidates.index(proof["backend"]) :]
    failures: list[Attempt] = []
    for backend in candidates:
        attempt = attempt_backend(backend, timeout_s=timeout_s, processes=processes)
        if attempt.is_ok:
            _accept(attempt, processes=processes, chosen_by="user" if requested else "crptpro")
            for failure in failures:
                logger.warning(
                    "%s Rendering with %s instead.", explain(failure, timeout_s, processes), backend
                )
            return backend
        failures.append(attempt)
    details = [explain(failure, timeout_s, processes) for failure in failures]
    raise RenderingError("\n  ".join([_nothing_renders(requested, imported), *details]))


def backend_card() -> dict[str, Any]:
    """Return the backend, the GL vendor, renderer and version, and whether GL is software or hardware.

    Raises:
        RenderingError: if no backend has been proven yet and none can be.
    """
    if _proof() is None:
        select_backend()
    proof = _proof() or {}
    keys = ("backend", "gl_vendor", "gl_renderer", "gl_version", "gl_kind")
    return {key: proof.get(key, "unknown") for key in keys}


@contextmanager
def first_frame_watchdog(timeout_s: float | None = None) -> Iterator[None]:
    """Log an error that names the cause if the body, which renders a first frame, does not return in time.

    A call that hangs inside the driver cannot be interrupted from Python, so the process is left as it is;
    what starts workers should end those that log this.
    """
    timeout_s = default_timeout_s() if timeout_s is None else timeout_s
    message = (
        f"Process {os.getpid()} has waited {timeout_s:g} s for its first frame. {HANG_CAUSE} {ALTERNATIVES}"
    )
    timer = threading.Timer(timeout_s, logger.error, args=(message,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def default_timeout_s() -> float:
    """Return the seconds a first frame may take."""
    text = os.environ.get(TIMEOUT_VARIABLE, "60")
    try:
        return float(text)
    except ValueError:
        raise RenderingError(f"{TIMEOUT_VARIABLE} must be a number of seconds, got {text!r}.") from None


def _carried_proof() -> dict[str, Any] | None:
    """Return the proof in the environment, wherever it was made."""
    try:
        proof = json.loads(os.environ.get(PROOF_VARIABLE) or "null")
    except json.JSONDecodeError:
        return None
    return proof if isinstance(proof, dict) and "backend" in proof else None


def _proof() -> dict[str, Any] | None:
    """Return the proof if it was made here: on this machine, for the same GPU."""
    proof = _carried_proof()
    is_ours = proof is not None and all(proof.get(name) == value for name, value in _place().items())
    return proof if is_ours else None


def _place() -> dict[str, Any]:
    """Return what a proof is bound to."""
    return {"host": socket.gethostname(), "egl_device": os.environ.get("MUJOCO_EGL_DEVICE_ID")}


def _requested_by_user() -> str | None:
    """Return the backend of a MUJOCO_GL that is not our own doing, here or where the environment comes from."""
    text = os.environ.get("MUJOCO_GL")
    proof = _carried_proof()
    if text is None or (proof and proof.get("chosen_by") == "crptpro" and text == proof["backend"]):
        return None
    backend = canonical_backend(text)
    if backend == "off":
        raise RenderingError(
            f"MUJOCO_GL={text} switches rendering off; unset it, or set it to egl or osmesa."
        )
    return backend


def _imported_backend() -> str | None:
    module = sys.modules.get("dm_control._render")
    name = getattr(module, "BACKEND", None)
    return name if name in BACKENDS else None


def platform_candidates() -> tuple[str, ...]:
    """Return the backends worth trying here, best first."""
    if not sys.platform.startswith("linux"):
        return ("glfw",)
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return BACKENDS if has_display else ("egl", "osmesa")


def _accept(attempt: Attempt, *, processes: int, chosen_by: str) -> None:
    # A user's spelling ("EGL", "on") becomes the one that dm_control and Gymnasium both understand.
    os.environ["MUJOCO_GL"] = attempt.backend
    if attempt.answer.get("gl_kind") == "software":
        os.environ.setdefault("LP_NUM_THREADS", "1")
    proof = {
        **attempt.answer, **_place(), "backend": attempt.backend, "processes": processes, "chosen_by": chosen_by,
    }  # fmt: skip
    os.environ[PROOF_VARIABLE] = json.dumps(proof)
    logger.info("GL backend %s: %s", attempt.backend, attempt.answer.get("gl_renderer"))


def explain(attempt: Attempt, timeout_s: float, processes: int = 1) -> str:
    """Return in one sentence or two why an attempt failed and what to do."""
    if attempt.is_timeout:
        where = f" from each of {processes} simultaneous processes" if processes > 1 else ""
        what = f"{attempt.backend}: the first frame did not arrive{where} within {timeout_s:g} s."
        return f"{what} {HANG_CAUSE} {ALTERNATIVES}"
    return f"{attempt.backend}: {attempt.reason} {attempt.remedy}".strip()


def _nothing_renders(requested: str | None, imported: str | None) -> str:
    if requested:
        return f"MUJOCO_GL={os.environ['MUJOCO_GL']} was set by you, is kept, and does not render a frame."
    if imported:
        return (
            f"dm_control was imported with the backend {imported!r} before one could be chosen, and it does "
            "not render a frame. Make the first environment before importing dm_control, or set MUJOCO_GL."
        )
    return "No GL backend renders a frame."

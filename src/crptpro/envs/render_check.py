"""Render domains with one backend and measure them, in a process that answers one JSON line per domain.

``python -m crptpro.envs.render_check walker cheetah``, with ``MUJOCO_GL`` naming the backend, is what
:func:`render_domains` runs.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import gymnasium

from crptpro.envs.factory import make_env
from crptpro.envs.gl_process import run_isolated
from crptpro.errors import CRPTproError, RenderingError
from crptpro.plugins import FLAG, load_plugin, loaded_plugins

WARM_UP_AGENT_STEPS = 2
TIMED_AGENT_STEPS = 6
_NO_FAULT = (ModuleNotFoundError, gymnasium.error.DependencyNotInstalled)
"""What a world lacks, whatever draws it."""


def check_domain(name: str) -> dict[str, Any]:
    """Step a domain at random and look at its pixels.

    Returns:
        ``domain``; ``reset_ms`` (the first reset, which makes the render context) and ``agent_step_ms``
        (physics and one image), wall-clock milliseconds; ``alive``: the images have content and change when
        the world is stepped; ``error``: why they could not be had, otherwise empty; ``is_drawing``: what is wrong,
        if anything, may be the fault of the backend.
    """
    try:
        env = make_env(name, seed=0, frame_stack=1)
        try:
            start = time.perf_counter()
            first = last = env.reset()
            reset_s = time.perf_counter() - start
            for agent_step in range(WARM_UP_AGENT_STEPS + TIMED_AGENT_STEPS):
                if agent_step == WARM_UP_AGENT_STEPS:
                    start = time.perf_counter()
                last = env.step(env.rand_action(last))["next"]
            agent_step_s = (time.perf_counter() - start) / TIMED_AGENT_STEPS
        finally:
            env.close()
    except CRPTproError as reason:
        return _dead(name, str(reason), is_drawing=isinstance(reason, RenderingError))
    except Exception as reason:  # whatever one domain does, those that follow are checked too
        return _dead(name, f"{type(reason).__name__}: {reason}", is_drawing=not isinstance(reason, _NO_FAULT))
    has_content = first["pixels"].unique().numel() > 1
    has_changed = not first["pixels"].equal(last["pixels"])
    return {
        "domain": name,
        "reset_ms": round(reset_s * 1e3, 1),
        "agent_step_ms": round(agent_step_s * 1e3, 2),
        "alive": has_content and has_changed,
        "error": "",
        "is_drawing": True,
    }


def render_domains(names: tuple[str, ...], backend: str, timeout_s: float) -> tuple[dict[str, Any], ...]:
    """Check domains in a process of its own, and in another one those that follow a domain that ended it.

    Args:
        names: Domains.
        backend: GL backend.
        timeout_s: For all of them together.

    Returns:
        What :func:`check_domain` returns, for each name.
    """
    entries: list[dict[str, Any]] = []
    deadline = time.monotonic() + timeout_s
    while len(entries) < len(names):
        plugins = [part for name in loaded_plugins() for part in (FLAG, name)]
        command = (sys.executable, "-m", "crptpro.envs.render_check", *plugins, *names[len(entries) :])
        left_s = max(0.0, deadline - time.monotonic())
        ((returncode, stdout, stderr),) = run_isolated([command], backend, timeout_s=left_s)
        lines = stdout.splitlines()
        entries += [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]
        unanswered = names[len(entries) :]
        if returncode is None:
            return (*entries, *(_dead(name, f"no answer within {timeout_s:g} s") for name in unanswered))
        if unanswered:
            how = f"signal {-returncode}" if returncode < 0 else f"exit status {returncode}"
            entries.append(_dead(unanswered[0], (stderr.strip().splitlines() or [how])[-1]))
    return tuple(entries)


def _dead(name: str, error: str, *, is_drawing: bool = True) -> dict[str, Any]:
    return {
        "domain": name,
        "reset_ms": None,
        "agent_step_ms": None,
        "alive": False,
        "error": error,
        "is_drawing": is_drawing,
    }


if __name__ == "__main__":
    arguments = sys.argv[1:]
    while arguments[:1] == [FLAG]:
        load_plugin(arguments[1])
        arguments = arguments[2:]
    for domain_name in arguments:
        sys.stdout.write(json.dumps(check_domain(domain_name)) + "\n")
        sys.stdout.flush()

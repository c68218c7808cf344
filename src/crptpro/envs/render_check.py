"""Render domains with one backend and measure them, in a process that answers one JSON line per domain.

``python -m crptpro.envs.render_check walker cheetah``, with ``MUJOCO_GL`` naming the backend.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from crptpro.envs.factory import make_env
from crptpro.errors import CRPTproError

WARM_UP_AGENT_STEPS = 2
TIMED_AGENT_STEPS = 6


def check_domain(name: str) -> dict[str, Any]:
    """Step a domain at random and look at its pixels.

    Returns:
        ``domain``; ``reset_ms`` (the first reset, which makes the render context) and ``agent_step_ms``
        (physics and one image), wall-clock milliseconds; ``alive``: the images have content and change when
        the world is stepped; ``error``: why they could not be had, otherwise empty.
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
        return {"domain": name, "reset_ms": None, "agent_step_ms": None, "alive": False, "error": str(reason)}
    has_content = first["pixels"].unique().numel() > 1
    has_changed = not first["pixels"].equal(last["pixels"])
    return {
        "domain": name,
        "reset_ms": round(reset_s * 1e3, 1),
        "agent_step_ms": round(agent_step_s * 1e3, 2),
        "alive": has_content and has_changed,
        "error": "",
    }


if __name__ == "__main__":
    for domain_name in sys.argv[1:]:
        sys.stdout.write(json.dumps(check_domain(domain_name)) + "\n")
        sys.stdout.flush()

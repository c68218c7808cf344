"""A task's name to a TorchRL environment that emits uint8 frame stacks."""

import os

from crptpro.envs.rendering import REMEDIES, canonical_backend
from crptpro.errors import RenderingError

# TorchRL imports MuJoCo, which answers a MUJOCO_GL that is wrong or not installed with a bare traceback.
_backend = canonical_backend(os.environ.get("MUJOCO_GL", "egl"))
try:
    import torchrl.envs  # noqa: F401
except (ImportError, AttributeError) as reason:
    if "MUJOCO_GL" not in os.environ:
        raise
    raise RenderingError(
        f"MUJOCO_GL={os.environ['MUJOCO_GL']} is set, and cannot be loaded: {reason}. {REMEDIES.get(_backend, '')} "
        "Or unset it, and the first backend that renders is taken."
    ) from reason

from crptpro.envs.factory import episode_length, make_env, needs_gl, resolve_action_repeat  # noqa: E402

__all__ = ["episode_length", "make_env", "needs_gl", "resolve_action_repeat"]

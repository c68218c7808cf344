"""A task's name to a TorchRL environment that emits uint8 frame stacks."""

import os

from crptpro.envs.gl_process import canonical_backend

# TorchRL imports MuJoCo, which answers a wrong MUJOCO_GL with a bare traceback: say it clearly before.
canonical_backend(os.environ.get("MUJOCO_GL", "egl"))

from crptpro.envs.factory import episode_length, make_env, needs_gl, resolve_action_repeat  # noqa: E402

__all__ = ["episode_length", "make_env", "needs_gl", "resolve_action_repeat"]

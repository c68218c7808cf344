"""TorchRL environments of tasks, which emit stacks of uint8 frames."""

from crptpro.envs.factory import episode_length, make_env, needs_gl, resolve_action_repeat
from crptpro.envs.rendering import select_backend

__all__ = ["episode_length", "make_env", "needs_gl", "resolve_action_repeat", "select_backend"]

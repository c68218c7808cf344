"""A task's name to a TorchRL environment that emits uint8 frame stacks."""

from crptpro.envs.factory import episode_length, make_env, needs_gl, resolve_action_repeat

__all__ = ["episode_length", "make_env", "needs_gl", "resolve_action_repeat"]

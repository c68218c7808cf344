"""A replay for what an environment shows and takes."""

from __future__ import annotations

from typing import Any

from torchrl.envs import EnvBase

from crptpro.data import FrameReplay


def replay_for(env: EnvBase, capacity: int, **options: Any) -> FrameReplay:
    """Make a replay of an environment's frames and actions.

    Args:
        env: read for its image size, frame stack and action length; ``pixels`` are ``[3 * frame_stack, H, W]``.
        capacity: transitions.
        **options: of :class:`~crptpro.data.FrameReplay`.

    Raises:
        DiskSpaceError: if the frames do not fit the disk.
    """
    channels, height, width = env.observation_spec["pixels"].shape
    return FrameReplay(
        capacity,
        frame_shape=(3, height, width),
        action_dim=env.action_spec.shape[-1],
        frame_stack=channels // 3,
        **options,
    )

"""Cuts the episodes of dm_control's worlds after 15 decisions, for the process that loads this as a plugin.

What a whole episode costs is not what a test of the smallest scale is about. Processes that collect do not load it.
"""

from __future__ import annotations

from typing import Any

from torchrl.envs import EnvBase

from crptpro.envs import factory
from crptpro.envs.episode_limit import EpisodeLimit
from crptpro.envs.own_env import with_transform

whole_episodes = factory._make_dm_env


def short_episodes(*arguments: Any, **settings: Any) -> EnvBase:
    """The same world, with an early end."""
    return with_transform(whole_episodes(*arguments, **settings), EpisodeLimit(15))


factory._make_dm_env = short_episodes

"""Datasets of frames stored once: collected by a random policy, read as a TorchRL replay buffer."""

from crptpro.data.collect import collect_group, collect_random
from crptpro.data.dataset import FrameDataset
from crptpro.data.episode import Episode
from crptpro.data.episode_writer import EpisodeWriter
from crptpro.data.frame_storage import FrameStorage
from crptpro.data.layout import Layout
from crptpro.data.replay import FrameReplay
from crptpro.data.stored_replay import StoredReplay

__all__ = [
    "Episode",
    "EpisodeWriter",
    "FrameDataset",
    "FrameReplay",
    "FrameStorage",
    "Layout",
    "StoredReplay",
    "collect_group",
    "collect_random",
]

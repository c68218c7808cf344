"""Datasets and replays of frames stored once, and random collection."""

from crptpro.data.collect import collect_group, collect_random
from crptpro.data.dataset import FrameDataset
from crptpro.data.replay import FrameReplay, StoredReplay

__all__ = ["FrameDataset", "FrameReplay", "StoredReplay", "collect_group", "collect_random"]

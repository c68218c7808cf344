"""Image-like episodes without a simulator, and datasets made of them by the library's own writer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crptpro.data import Episode
from crptpro.data.collection import DomainCollection

#: Side of the noise that is blown up to an image: patches of a few pixels, as rendered scenes have.
_PATCHES = 12


def drifting_episode(transitions: int, *, seed: int, image_size: int = 84, action_dim: int = 6) -> Episode:
    """Make an episode that shows one smooth picture drifting by a pixel or two per transition.

    No two of its frames are equal as long as it has fewer than ``image_size ** 2`` of them.

    Args:
        transitions: T.
        seed: Of the picture, the actions and the rewards.
        image_size: H = W, pixels.
        action_dim: A.

    Returns:
        An episode of T + 1 frames uint8 ``[3, H, W]``, truncated at its end, without physical state.
    """
    rng = np.random.default_rng(seed)
    scene = _picture(rng, image_size)
    frames = [np.roll(scene, (t, 2 * t + t // image_size), axis=(1, 2)) for t in range(transitions + 1)]
    truncated = np.zeros(transitions, dtype=bool)
    truncated[-1] = True
    return Episode(
        pixels=np.stack(frames),
        action=rng.uniform(-1, 1, (transitions, action_dim)).astype(np.float32),
        reward=rng.uniform(0, 1, transitions).astype(np.float32),
        terminated=np.zeros(transitions, dtype=bool),
        truncated=truncated,
    )


def write_dataset(
    path: Path, *, transitions: int, seed: int = 0, image_size: int = 84, episode_transitions: int = 500
) -> Path:
    """Write a dataset of drifting pictures that :meth:`crptpro.data.FrameDataset.open` reads.

    Args:
        path: Its directory.
        transitions: In all; the last episode is cut to fit.
        seed: Of every episode.
        image_size: H = W, pixels.
        episode_transitions: Of a whole episode.

    Returns:
        ``path``.
    """
    request = {
        "domain": path.name, "task": "drifting_picture", "seed": seed, "transitions": transitions,
        "image_size": image_size, "action_repeat": 2, "camera": 0, "quality": "exact",
    }  # fmt: skip
    collection = DomainCollection(path, request, episode_transitions)
    try:
        while (job := collection.next_job()) is not None:
            length = min(job.limit, episode_transitions)
            episode = drifting_episode(length, seed=job.env_seed, image_size=image_size)
            collection.accept(job.episode, episode)
    finally:
        collection.close()
    return path


def _picture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return noise of a few large patches, interpolated, with a little grain: uint8 ``[3, size, size]``."""
    coarse = rng.uniform(20, 235, (3, _PATCHES, _PATCHES))
    at = np.linspace(0, _PATCHES - 1, size)
    low = np.minimum(at.astype(int), _PATCHES - 2)
    share = at - low
    rows = coarse[:, low] * (1 - share)[:, None] + coarse[:, low + 1] * share[:, None]
    smooth = rows[:, :, low] * (1 - share) + rows[:, :, low + 1] * share
    return (smooth + rng.normal(0, 3, smooth.shape)).clip(0, 255).astype(np.uint8)

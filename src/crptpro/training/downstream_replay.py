"""The replay of a downstream run: frames in the run's directory, or a stand-in where nothing is left to learn."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import torch
from torchrl.envs import EnvBase

from crptpro.data import FrameReplay
from crptpro.downstream_config import DownstreamConfig
from crptpro.training.env_replay import replay_for

DIRECTORY = "replay"
SPARE_FRAMES = 2_000
"""Room for the rest of an episode, at whose end a checkpoint that is due is written, and its first frames."""

logger = logging.getLogger(__name__)


class SlackWatch:
    """Says once that an episode has gone on for longer than a killed run can be continued from.

    Args:
        replay: whose slack it is.
    """

    def __init__(self, replay: FrameReplay) -> None:
        self.replay = replay
        self._frames: int | None = None
        self._has_warned = False

    def saved(self) -> None:
        """Count from here: a checkpoint refers to what the replay holds now."""
        self._frames = self.replay.frames_written

    def check(self) -> None:
        """Warn where more frames were stored since the checkpoint than the replay has to spare."""
        if self._frames is None or self._has_warned:
            return
        since = self.replay.frames_written - self._frames
        if since > self.replay.slack:
            self._has_warned = True
            logger.warning(
                "This episode has stored %s frames since the last checkpoint, the replay can spare %s: until the "
                "episode ends and the next checkpoint is written, this run could not be continued. Begin with a larger "
                "`checkpoint_interval_env_steps`, which makes more room, or with shorter episodes.",
                f"{since:,}", f"{self.replay.slack:,}",
            )  # fmt: skip


def make_replay(
    env: EnvBase, config: DownstreamConfig, generator: torch.Generator, run_dir: Path
) -> FrameReplay:
    """Make the replay of a run, or open the one that its directory has.

    Args:
        env: read for its image, stack and action sizes.
        config: capacity, and how often there is a checkpoint.
        generator: draws the batches.
        run_dir: the frames go below it.

    Raises:
        DiskSpaceError: if the frames do not fit the disk.
    """
    # A checkpoint holds cursors, not frames: whatever it refers to must outlive the next one, and the one after
    # that while it is being written.
    slack = 2 * (config.checkpoint_interval_env_steps // config.resolved_action_repeat) + SPARE_FRAMES
    replay = replay_for(env, config.resolved_replay_capacity, path=run_dir / DIRECTORY, slack=slack)
    replay.set_rng(generator)
    return replay


def empty_replay(env: EnvBase) -> FrameReplay:
    """Return what a finished run has instead of a replay: a few rows in RAM, which nobody writes or reads."""
    return replay_for(env, 1)


def has_replay(run_dir: Path) -> bool:
    """Whether a run's frames are there."""
    return (run_dir / DIRECTORY / "pixels.memmap").exists()


def remove_replay(run_dir: Path) -> None:
    """Remove the frames of an attempt that left no checkpoint: they may be of another size."""
    shutil.rmtree(run_dir / DIRECTORY, ignore_errors=True)

"""The state of one dataset while it is being collected: what is durable, what is running, what comes next."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from crptpro.cards import provenance, write_json
from crptpro.data.card import read_card
from crptpro.data.collect_worker import EpisodeJob
from crptpro.data.collection_state import CollectionState, require_free, require_request
from crptpro.data.episode import Episode
from crptpro.data.episode_writer import EpisodeWriter
from crptpro.data.incoming import drop_all_incoming, drop_incoming, read_incoming, write_incoming
from crptpro.data.layout import (
    CARD_FILE,
    FORMAT,
    PIXELS,
    VERSION,
    estimate_bytes,
    write_tensordict_metadata,
)
from crptpro.directory_lock import DirectoryLock
from crptpro.domains import LONGEST_EPISODE_AGENT_STEPS
from crptpro.errors import DatasetError, DiskSpaceError, is_disk_full
from crptpro.seeding import derive_seed

logger = logging.getLogger(__name__)


class DomainCollection:
    """Collects the episodes 0, 1, 2, ... of one domain until they hold the transitions asked for.

    Episodes may arrive in any order and are appended in order; one that is early waits on disk. Thus the
    dataset depends on ``request`` alone, and a kill costs only the episodes that were running.

    Args:
        path: The dataset's directory.
        request: What is asked for: domain, task, seed, transitions, image_size, action_repeat, camera,
            quality, colors.
        episode_agent_steps: Usual length of an episode, ``None`` if unknown. It only saves work.

    Raises:
        DatasetError: if the directory holds something else, or another process is collecting there.
    """

    def __init__(self, path: Path, request: dict[str, Any], episode_agent_steps: int | None = None):
        self.path, self.request = path, request
        self.name: str = request["domain"]
        self.target: int = request["transitions"]
        self._last_append_s: float | None = None
        self._usual_length = episode_agent_steps
        self._longest = max(LONGEST_EPISODE_AGENT_STEPS, episode_agent_steps or 0)
        self._seen_lengths: set[int] = set()
        self._running: dict[int, int] = {}
        self._waiting: dict[int, Episode] = {}
        self._writer: EpisodeWriter | None = None
        self._lock: DirectoryLock | None = None
        self._state = CollectionState(path, request)
        self.is_complete = False
        if (path / CARD_FILE).exists():
            require_request(path, read_card(path).get("request", {}), request, "holds a dataset")
            self.is_complete = True
            return
        require_free(path)
        self._lock = DirectoryLock(path, error=DatasetError)
        try:
            if (path / CARD_FILE).exists():  # another process has finished it just now
                require_request(path, read_card(path).get("request", {}), request, "holds a dataset")
                self.is_complete = True
                self.close()
                return
            self._resume()
        except BaseException:
            self.close()
            raise

    @property
    def transitions(self) -> int:
        """Durable transitions."""
        return self.target if self.is_complete else self._writer.transitions if self._writer else 0

    @property
    def transitions_seen(self) -> int:
        """Transitions made so far, those of waiting and running episodes included."""
        early = sum(map(len, self._waiting.values())) + sum(self._running.values())
        return min(self.target, self.transitions + early)

    def missing_bytes(self) -> int:
        """Estimate what is still to be written."""
        if self.is_complete:
            return 0
        missing = self.target - self.transitions
        return estimate_bytes(missing, self.request["image_size"], self._usual_length)

    def next_job(self) -> EpisodeJob | None:
        """Return the next episode worth starting, ``None`` while those under way are expected to suffice."""
        if self.is_complete:
            return None
        episode = self._writer.episodes if self._writer else 0
        needed = self.target - self.transitions  # for certain, if the usual length is right
        expected = needed
        while episode in self._waiting or episode in self._running:
            if episode in self._waiting:
                needed -= len(self._waiting[episode])
                expected -= len(self._waiting[episode])
            else:
                needed -= self._usual_length or max(1, self._running[episode])
                expected -= self._expected_length(episode)
            episode += 1
        if needed <= 0 or expected <= 0:
            return None
        if self._last_append_s is None:  # not before: domains that share a pool take turns
            self._last_append_s = time.monotonic()
        self._running[episode] = 0
        seed = self.request["seed"]
        return EpisodeJob(
            domain=self.name,
            episode=episode,
            env_seed=derive_seed(seed, "collect", self.name, episode),
            action_seed=derive_seed(seed, "collect-actions", self.name, episode),
            limit=min(needed, self._longest),
        )

    def note_progress(self, episode: int, transitions: int) -> None:
        """Note how far a running episode is."""
        if episode in self._running:
            self._running[episode] = transitions

    def note_environment(self, card: dict[str, Any]) -> None:
        """Note what renders the frames.

        Raises:
            DatasetError: if earlier episodes were rendered by another backend or renderer.
        """
        self._state.note_environment(card)

    def accept(self, index: int, episode: Episode) -> None:
        """Take a collected episode; it and those that waited for it are durable when this returns.

        Raises:
            DiskSpaceError: if the disk is full; everything appended before is kept.
            DatasetError: if it cannot be written for another reason.
        """
        self._running.pop(index, None)
        if self.is_complete:
            return
        try:
            self._take(index, episode)
        except (OSError, DiskSpaceError) as reason:
            if not is_disk_full(reason):
                raise DatasetError(f"{self.path} cannot be written: {reason}.") from reason
            raise DiskSpaceError(
                f"The disk under {self.path} is full after {self.transitions} transitions, which are kept. Free space "
                "and run the same command again."
            ) from reason

    def _take(self, index: int, episode: Episode) -> None:
        if not episode.is_cut:
            self._seen_lengths.add(len(episode))
        if self._writer is None:
            self._state.note_layout(episode.layout)
            self._writer = EpisodeWriter(self.path, episode.layout)
        self._waiting[index] = episode
        if index != self._writer.episodes:
            write_incoming(self.path, index, episode)
        self._append_ready()

    def close(self) -> None:
        """Release files and lock; the collection can be continued later."""
        if self._writer is not None:
            self._writer.close()
        if self._lock is not None:
            self._lock.release()

    def _append_ready(self) -> None:
        writer = self._writer
        assert writer is not None
        while (
            writer.transitions < self.target
            and (episode := self._waiting.pop(writer.episodes, None)) is not None
        ):
            index = writer.episodes
            needed = self.target - writer.transitions
            if episode.is_cut and len(episode) < min(needed, self._longest):
                # It was stopped in the belief that earlier episodes would be longer: it is collected again.
                self._usual_length = None
            else:
                now = time.monotonic()
                writer.append(episode.cut(needed), wall_s=now - (self._last_append_s or now))
                self._last_append_s = now if self._last_append_s else None
            drop_incoming(self.path, index)
            if index == writer.episodes:
                return
        if writer.transitions >= self.target:
            self._finish()

    def _finish(self) -> None:
        writer = self._writer
        assert writer is not None
        transitions, frames = writer.transitions, writer.frames
        write_tensordict_metadata(self.path, writer.layout, transitions, frames)
        drop_all_incoming(self.path)
        card = {
            "format": FORMAT,
            "version": VERSION,
            **self.request,
            "request": self.request,
            "frame_stack": 3,
            "pixels": PIXELS,
            "episodes": writer.episodes,
            "frames": frames,
            "layout": writer.layout.to_dict(),
            "bytes": writer.layout.bytes(transitions, frames),
            "last_episode_cut": writer.entries[-1].is_cut,
            "crc32": [entry.crc32 for entry in writer.entries],
            "wall_time_s": round(sum(entry.wall_s for entry in writer.entries), 1),
            "longest_episode": self._longest,
            "policy": "uniform random in [-1, 1]",
            "render": self._state.sessions[-1]["render"] if self._state.sessions else {},
            "sessions": self._state.sessions,
            **provenance(),
        }
        # The card is the mark of a complete dataset, so it is written last.
        write_json(self.path / CARD_FILE, card)
        self.is_complete = True
        self.close()

    def _resume(self) -> None:
        self._state.resume()
        if self._state.layout is None:
            return
        self._writer = EpisodeWriter(self.path, self._state.layout)
        for index, episode in read_incoming(self.path):
            if episode.layout == self._writer.layout and index >= self._writer.episodes:
                self._waiting[index] = episode
        logger.info("%s: continuing after %d of %d transitions", self.name, self.transitions, self.target)
        self._append_ready()

    def _expected_length(self, episode: int) -> int:
        if self._usual_length is not None:
            return self._usual_length
        usual = next(iter(self._seen_lengths)) if len(self._seen_lengths) == 1 else 1
        return max(usual, self._running[episode])

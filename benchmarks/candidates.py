"""What ``benchmarks.updates`` times: every implementation of an update, on the same transitions and weights."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.library_updates import (
    DownstreamUpdates,
    PretrainUpdates,
    fresh_loss,
    precisions,
    synthetic_episodes,
)
from benchmarks.measure import Timing, side_by_side
from benchmarks.peer import Peer
from benchmarks.plain_downstream import PlainDownstream
from benchmarks.plain_pretrain import PlainPretraining
from benchmarks.plain_store import StackedStore
from crptpro.data import FrameDataset
from crptpro.downstream_config import DownstreamConfig
from crptpro.pretrained import Pretrained

PLAIN = "plain fp32"
PEER = "peer fp32"

Candidates = Mapping[str, Callable[[], Any]]


def pretrain_candidates(
    datasets: Sequence[FrameDataset],
    *,
    batch_size: int,
    image_size: int,
    prototypes: int,
    plain_transitions: int,
    peer: Peer | None = None,
) -> Candidates:
    """Build one call per implementation that does one pre-training update.

    Args:
        datasets: of as many domains; ours takes them in turn, the others hold the first in memory.
        batch_size: transitions per update.
        image_size: of the datasets, pixels.
        prototypes: M.
        plain_transitions: of the first dataset, as many as memory is to be spent on.
        peer: a released agent to compare with.
    """
    new_loss = functools.partial(fresh_loss, image_size=image_size, prototypes=prototypes)
    store = StackedStore.of(datasets[0], plain_transitions)
    plain = PlainPretraining.like(new_loss())
    candidates: dict[str, Callable[[], Any]] = {PLAIN: lambda: plain.sample_and_update(store, batch_size)}
    if peer is not None:
        candidates[PEER] = peer.pretrain_update(store)
    for precision in precisions():
        candidates[f"ours {precision}"] = PretrainUpdates(
            new_loss(), datasets, batch_size=batch_size, precision=precision
        )
    return candidates


def downstream_candidates(
    pretrained: Pretrained, config: DownstreamConfig, *, scratch: Path, peer: Peer | None = None
) -> Candidates:
    """Build one call per implementation that does one downstream update, every second with the actor.

    Args:
        pretrained: encoder, projector and prototypes.
        config: every number; the replay is filled with synthetic transitions.
        scratch: directory for the replays' files.
        peer: a released agent to compare with.

    Raises:
        CRPTproError: if the dense maps do not fit the memory.
    """
    episodes = list(synthetic_episodes(config.resolved_replay_capacity, pretrained.encoder.image_size))
    ours: dict[str, DownstreamUpdates] = {}
    ways = [("reencode", "auto", "encoding anew"), ("dense", "auto", "dense features")]
    if precisions() == ["fp32"]:  # where auto is bf16, it has both: half the memory, and faster arithmetic
        ways.insert(1, ("dense", "bf16", "dense features in bf16"))
    for features, dense_precision, words in ways:
        for precision in precisions():
            changes: dict[str, Any] = {
                "features": features, "dense_precision": dense_precision, "precision": precision,
            }  # fmt: skip
            ours[f"ours {precision}, {words}"] = DownstreamUpdates(
                pretrained,
                episodes,
                config=dataclasses.replace(config, **changes),
                run_dir=scratch / "_".join(changes.values()),
            )
    parts = next(iter(ours.values())).parts
    store = StackedStore.of(parts.replay, len(parts.replay))
    plain = PlainDownstream.like(pretrained, parts.learner.loss.actor, parts.learner.loss.critic)
    agent_step = itertools.count()
    candidates: dict[str, Callable[[], Any]] = {
        PLAIN: lambda: plain.sample_and_update(store, config.batch_size, next(agent_step))
    }
    if peer is not None:
        candidates[PEER] = peer.downstream_update(store)
    return candidates | ours


def time_in_pairs(candidates: Candidates, *, rounds: int, warmup: int) -> dict[str, Timing]:
    """Time two downstream updates a call, so that the actor takes part in one of them, and return their means."""

    def twice(call: Callable[[], Any]) -> None:
        call()
        call()

    pairs = {name: functools.partial(twice, call) for name, call in candidates.items()}
    return {
        name: Timing(pair.median_s / 2, pair.best_s / 2, pair.worst_s / 2, pair.rounds)
        for name, pair in side_by_side(pairs, rounds=rounds, warmup=warmup).items()
    }

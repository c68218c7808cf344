"""What a checkpoint of an active pre-training holds, and how a run takes it up again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from crptpro.seeding import global_rng_state, set_global_rng_state

if TYPE_CHECKING:
    from crptpro.training.explore.run import ActiveRun

STREAMS = ("pretrain", "explore", "episodes")
"""Streams of the record that a resumed run cuts back to its checkpoint."""


def state_of(run: ActiveRun) -> dict[str, Any]:
    """Return everything a resumed run needs; frames are already on disk, in the replays' own files."""
    return {
        "fingerprint": run.fingerprint,
        "decisions": run.decisions,
        "is_finished": run.decisions == run.plan.decisions,
        "updates": run.updates,
        "seconds": run.seconds,
        "learner": run.learner.state_dict(),
        "members": {member.name: member.state_dict() for member in run.members},
        "batches": [batches.state_dict() for batches in run.batches],
        "rewards": [reward.state_dict() for reward in run.rewards],
        "global_rng": global_rng_state(),
        "window": run.window.state_dict(),
        "monitor": run.monitor.state_dict(),
        "sums": run.sums,
        "counts": run.counts,
        "made_with": run.made_with,
        "records": None if run.records is None else run.records.state_dict(STREAMS),
    }


def restore(run: ActiveRun, state: Mapping[str, Any]) -> None:
    """Put a run with the same settings where :func:`state_of` saw it."""
    run.decisions = run.saved_at = state["decisions"]
    run.updates = run.resumed_from = run.row_updates = state["updates"]
    run.earlier_seconds = state["seconds"]
    run.learner.load_state_dict(state["learner"])
    for index, member in enumerate(run.members):
        member.load_state_dict(state["members"][member.name])
        if run.batches:
            run.batches[index].load_state_dict(state["batches"][index])
        run.rewards[index].load_state_dict(state["rewards"][index])
    set_global_rng_state(state["global_rng"])
    run.window.load_state_dict(state["window"], run.device)
    run.monitor.load_state_dict(state["monitor"])
    run.sums, run.counts = list(state["sums"]), list(state["counts"])
    if run.records is not None and state["records"] is not None:
        run.records.load_state_dict(state["records"])
    if run.decisions == run.plan.decisions:
        run.made_with = state["made_with"]  # nothing is trained now: say what did it


def action_sizes(state: Mapping[str, Any]) -> dict[str, int]:
    """Return the length of each domain's actions, by name."""
    return {name: member["actions"].shape[-1] for name, member in state["members"].items()}

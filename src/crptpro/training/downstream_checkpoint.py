"""What a downstream checkpoint holds, and how a run takes it up again."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from crptpro.downstream_config import DownstreamConfig, SkillDDPGSettings
from crptpro.errors import CheckpointError
from crptpro.seeding import global_rng_state, set_global_rng_state
from crptpro.training.downstream_replay import DIRECTORY, has_replay
from crptpro.training.fingerprint import require_same

if TYPE_CHECKING:
    from crptpro.training.downstream_run import DownstreamRun

logger = logging.getLogger(__name__)

STREAMS = ("train", "episodes", "eval")
"""Streams of the record that a resumed run cuts back to its checkpoint."""

COUNTERS = ("agent_steps", "updates", "episodes", "last_eval", "next_eval", "next_checkpoint")

FREE_TO_CHANGE = (
    "env_steps", "device", "features", "precision", "channels_last", "compile", "cuda_graph", "eval_workers",
    "render_ahead",
)  # fmt: skip
"""Settings that a run may be continued with other values of: budgets may grow, machines differ. What `auto` became
is compared instead of what was asked."""

CAME_LATER: dict[str, Any] = {
    "algorithm": "rad-sac",
    "skill_ddpg": dataclasses.asdict(SkillDDPGSettings()),
    "transfer_actor": None,
    "colors": "normal",
    "dense_precision": "auto",
}
"""Settings that checkpoints of earlier versions do not name, with what was the case then."""


RESOLVED = ("precision", "features", "projections", "compile", "channels_last", "action noise")
"""What a fingerprint tells of a run that was built, beside what was asked."""


def require_continuable(
    state: Mapping[str, Any],
    *,
    task: str,
    pretrained: str | None,
    config: DownstreamConfig,
    run_dir: Path,
) -> None:
    """Refuse what can be seen to be another run, before environments and replays are made.

    Args:
        state: of the checkpoint.
        task: what is asked to be learned.
        pretrained: identity of the encoder, None if it is trained here.
        config: what is asked.
        run_dir: where the run is.

    Raises:
        CheckpointError: if the state belongs to a run with other settings, or one that went beyond the budget, or
            the replay that it needs is gone.
    """
    saved = {**CAME_LATER, **state["fingerprint"]}
    now = {"task": task, **_asked(config), "pretrained": pretrained}
    if config.features != "auto" and saved.get("features") != "trained":
        now["features"] = config.features
    require_same(
        {name: value for name, value in saved.items() if name in now or name not in RESOLVED}, now, run_dir
    )
    done = env_steps_of(state, config)
    if done - config.resolved_action_repeat >= config.env_steps:
        raise CheckpointError(
            f"{run_dir} has done {done:,} env steps, {config.env_steps:,} are asked: ask for at least as many, "
            "or choose another run directory."
        )

    if not is_complete(state, config) and not has_replay(run_dir):
        raise CheckpointError(
            f"{run_dir} has done {done:,} of {config.env_steps:,} env steps; to go on it needs its frames, and "
            f"{run_dir / DIRECTORY} is gone. Put it back, or start in another run directory."
        )


def is_complete(state: Mapping[str, Any], config: DownstreamConfig) -> bool:
    """Whether nothing is left of the budget, nor to be evaluated: such a run is only read."""
    done = env_steps_of(state, config)
    is_pending = state.get("evaluation", {}).get("pending") is not None
    is_evaluated = state["counters"]["last_eval"] == done and not is_pending
    return done >= config.env_steps and is_evaluated


def env_steps_of(state: Mapping[str, Any], config: DownstreamConfig) -> int:
    """Return the simulator steps that a checkpoint's run had taken."""
    return state["counters"]["agent_steps"] * config.resolved_action_repeat


def fingerprint(run: DownstreamRun) -> dict[str, Any]:
    """Return everything that must agree for a checkpoint to be continued."""
    resolved = {
        "precision": "bf16" if run.parts.encoder.compute_dtype == torch.bfloat16 else "fp32",
        "features": run.parts.feature_mode,
        "projections": "kept" if run.parts.features.keeps_projections else "computed",
    }
    # Only where they are used: a run from before they existed can be continued.
    compiled = getattr(run.parts.learner, "compiled", None)
    if compiled is not None and compiled.is_on:
        resolved["compile"] = "on"
    if not run.parts.encoder.channels_last:
        resolved["channels_last"] = "off"
    if getattr(run.parts.learner, "generator", None) is not None:
        resolved["action noise"] = "drawn on the device"
    return {"task": run.task, **_asked(run.config), **resolved, "pretrained": run.pretrained_identity}


def state_of(run: DownstreamRun) -> dict[str, Any]:
    """Return everything a resumed run needs; frames are already on disk, in the replay's own files."""
    return {
        "fingerprint": fingerprint(run),
        "counters": {name: getattr(run, name) for name in COUNTERS},
        **run.parts.state_dict(),
        "generators": {name: generator.get_state() for name, generator in run.generators.items()},
        "global_rng": global_rng_state(),
        "sums": run.sums,
        "counts": run.counts,
        "records": run.records.state_dict(STREAMS),
        "evaluation": run.evaluation.state_dict(),
    }


def resume(run: DownstreamRun, state: Mapping[str, Any] | None, *, progress: bool) -> None:
    """Continue from a checkpoint's state; without one, clear the record for a fresh start.

    Args:
        run: built with the same state.
        state: from :func:`state_of`.
        progress: show a bar while observations are encoded again.

    Raises:
        CheckpointError: if it belongs to a run that was built in another way, or frames that it needs are gone.
    """
    if state is None:
        # Rows of an attempt that was killed before its first checkpoint; elsewhere they may be another run's.
        if run.records.writes_into(run.run_dir):
            for stream in STREAMS:
                run.records.truncate_to(stream, "env_steps", -1)
        return
    restore(run, state)
    if run.env_steps >= run.config.env_steps:
        logger.info("%s: already at %s env steps", run.task, f"{run.env_steps:,}")
        return
    logger.info("%s: continuing from %s env steps", run.task, f"{run.env_steps:,}")
    run.parts.features.rebuild(progress=progress)


def restore(run: DownstreamRun, state: Mapping[str, Any]) -> None:
    """Put a run where :func:`state_of` saw it; dense feature maps are rebuilt by the caller.

    A complete run gets no replay back.

    Raises:
        CheckpointError: if the state belongs to a run that was built in another way; nothing has changed then.
    """
    require_same({**CAME_LATER, **state["fingerprint"]}, fingerprint(run), run.run_dir)
    for name, value in state["counters"].items():
        setattr(run, name, value)
    run.parts.load_state_dict(state, with_replay=not is_complete(state, run.config))
    run.slack.saved()
    for name, generator in run.generators.items():
        generator.set_state(state["generators"][name])
    set_global_rng_state(state["global_rng"])
    run.sums, run.counts = dict(state["sums"]), dict(state["counts"])
    run.records.load_state_dict(state["records"])
    run.evaluation.load_state_dict(state["evaluation"], run.agent())


def _asked(config: DownstreamConfig) -> dict[str, Any]:
    """Settings that must agree as they were asked."""
    return {name: value for name, value in dataclasses.asdict(config).items() if name not in FREE_TO_CHANGE}

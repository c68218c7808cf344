"""Downstream reinforcement learning: on a frozen encoder (CRPTpro, Sec. III-C), or end to end for comparison."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crptpro.directory_lock import DirectoryLock
from crptpro.downstream_config import DownstreamConfig
from crptpro.envs import make_env
from crptpro.errors import CheckpointError, PretrainedError
from crptpro.loggers import RunLogger
from crptpro.modules import usable_device
from crptpro.objectives import Method, get_method, methods
from crptpro.pretrained import Pretrained, load_pretrained, random_pretrained
from crptpro.seeding import kept_global_rng
from crptpro.training.action_repeat import action_repeat_of
from crptpro.training.agent import PixelAgent
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.downstream_checkpoint import require_continuable
from crptpro.training.downstream_checkpoint import resume as resume_run
from crptpro.training.downstream_replay import remove_replay
from crptpro.training.downstream_run import DownstreamRun, EnvFactory


@dataclass(frozen=True)
class DownstreamResult:
    """What a downstream run leaves.

    Attributes:
        policy: the trained agent, deterministic.
        evaluations: one row per evaluated episode: ``env_steps``, ``episode``, ``episode_return``, ...
        agent_path: artifact of the agent, ``None`` without a run directory.
        env_steps: simulator steps taken.
    """

    policy: PixelAgent
    evaluations: list[dict[str, Any]]
    agent_path: Path | None
    env_steps: int


def train_downstream(
    task: str,
    pretrained: Pretrained | str | Path | None,
    *,
    run_dir: str | Path | None = None,
    config: DownstreamConfig | None = None,
    logger: RunLogger | None = None,
    resume: bool = True,
    progress: bool = True,
    env_factory: EnvFactory = make_env,
    **overrides: Any,
) -> DownstreamResult:
    """Train an agent on a task: SAC with the encoder frozen, or what ``config.algorithm`` says.

    Args:
        task: any name that :func:`crptpro.envs.make_env` knows.
        pretrained: an artifact or its directory. Without prototypes there is no bonus, which is said once. None for
            DrQ, whose encoder starts from the seed: ``train_downstream(task, None, config=drq_settings())``.
        run_dir: records, checkpoints and the agent go here; ``None`` keeps nothing but the result.
        config: every number; the paper's by default.
        logger: records and mirrors; by default a local record in ``run_dir``.
        resume: continue from the newest checkpoint in ``run_dir``. Checkpoints are taken between episodes, so a
            kill costs the episodes since the last one and, on a CPU, changes no number.
        progress: show bars (never in log files).
        env_factory: makes the environments; called as :func:`~crptpro.envs.make_env` is, in a thread of its own and in
            the processes that evaluate (see ``render_ahead`` and ``eval_workers``).
        **overrides: single settings of :class:`DownstreamConfig`, e.g. ``env_steps=100_000``.

    Returns:
        The agent and every evaluated episode.

    Raises:
        CRPTproError: if the device cannot be used.
        PretrainedError: if the artifact does not fit, e.g. another image size, or actor weights only; if there is none
            for a frozen encoder, or one for DrQ.
        CheckpointError: if ``run_dir`` holds a run with other settings, or one that cannot go on: its replay is gone,
            or the dense maps that it began with do not fit the memory. A finished run needs neither.
        NonFiniteError: if a loss became NaN or infinite; the last checkpoint is kept.
    """
    config = dataclasses.replace(config or DownstreamConfig(), **overrides)
    usable_device(config.device)
    config = dataclasses.replace(config, action_repeat=action_repeat_of(task, config.action_repeat))
    artifact = _artifact(pretrained, config)
    config = dataclasses.replace(config, replay_capacity=_replay_capacity(artifact, config))
    with contextlib.ExitStack() as stack:
        stack.enter_context(kept_global_rng())
        directory = Path(run_dir or stack.enter_context(tempfile.TemporaryDirectory(prefix="crptpro-")))
        stack.enter_context(DirectoryLock(directory, error=CheckpointError, is_reentrant=True))
        records = logger or stack.enter_context(
            RunLogger(directory, config={"task": task, **dataclasses.asdict(config)})
        )
        checkpoints = CheckpointDir(directory / "checkpoints")
        if not resume and checkpoints.latest_counter() is not None:
            raise CheckpointError(
                f"{directory} already holds a run. Choose another directory, or continue it (resume=True)."
            )
        state = None if run_dir is None else checkpoints.load_latest()
        if state is None:
            remove_replay(directory)
        else:
            require_continuable(
                state,
                task=task,
                pretrained=None if config.algorithm == "drq" else artifact.identity(),
                config=config,
                run_dir=directory,
            )
        run = DownstreamRun(
            task,
            artifact,
            directory,
            config,
            records,
            progress=progress,
            env_factory=env_factory,
            state=state,
        )
        stack.callback(run.close)
        resume_run(run, state, progress=progress)
        run.train(checkpoints if run_dir is not None else None)
        agent_path = run.save_agent() if run_dir is not None else None
        return DownstreamResult(run.agent(), records.rows("eval"), agent_path, run.env_steps)


def _artifact(pretrained: Pretrained | str | Path | None, config: DownstreamConfig) -> Pretrained:
    if config.algorithm == "drq":
        if pretrained is not None:
            raise PretrainedError(
                "DrQ trains its encoder from scratch and takes no pretrained one; leave it out (None), or choose "
                "algorithm='rad-sac' to learn on this encoder."
            )
        return random_pretrained(seed=config.seed)
    if pretrained is None:
        raise PretrainedError(
            f"{config.algorithm} learns on a frozen encoder: give it a pretrained artifact, or random_pretrained() as "
            "the control. Only drq needs none."
        )
    return pretrained if isinstance(pretrained, Pretrained) else load_pretrained(pretrained)


def _replay_capacity(pretrained: Pretrained, config: DownstreamConfig) -> int:
    """Transitions to keep: as asked, or what the artifact's method keeps, and at least the random phase."""
    if config.replay_capacity is not None:
        return config.replay_capacity
    known = pretrained.method in methods(presets=True)
    usual = get_method(pretrained.method).replay_capacity if known else Method.replay_capacity
    return max(usual, config.random_agent_steps)

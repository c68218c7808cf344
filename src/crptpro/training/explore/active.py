"""Active pre-training: an agent explores each domain while one encoder learns from all of them."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.directory_lock import DirectoryLock
from crptpro.domains import Domain
from crptpro.envs import make_env
from crptpro.errors import CheckpointError
from crptpro.loggers import RunLogger
from crptpro.modules import (
    computing,
    is_channels_last,
    resolve_channels_last,
    resolve_precision,
    usable_device,
)
from crptpro.objectives import (
    exploration_defaults,
    exploring_method,
    get_method,
    method_defaults,
    method_name_of,
    methods,
)
from crptpro.seeding import derive_seed, kept_global_rng
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.explore.assemble import assemble, fingerprint
from crptpro.training.explore.checkpoint import action_sizes
from crptpro.training.explore.plan import resolve
from crptpro.training.explore.replays import DIRECTORY
from crptpro.training.explore.request import domain_names, require_explorable, warn_of_unread
from crptpro.training.fingerprint import precision_to_continue, require_same
from crptpro.training.pretrain.result import PretrainResult, training_record

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class ActiveResult(PretrainResult):
    """How an active pre-training ended.

    Attributes:
        env_steps: simulator steps over all domains.
        actors: the agent's actor of each domain, by name.
    """

    env_steps: int = 0
    actors: dict[str, nn.Module] = field(default_factory=dict, repr=False)


def pretrain_active(
    loss: LossModule,
    domains: str | Domain | Sequence[str | Domain],
    *,
    run_dir: str | Path | None = None,
    config: ActiveConfig | None = None,
    logger: RunLogger | None = None,
    resume: bool = True,
    progress: bool = True,
    env_factory: Callable[..., EnvBase] = make_env,
    **overrides: Any,
) -> ActiveResult:
    """Train a self-supervised loss on what exploring agents see (Proto-RL, APT, BeCL; here also across domains).

    The domains take turns, one decision each. A domain has its own environment, replay, actor, critic and temperature;
    encoder, heads, prototypes and their optimiser are shared. Its agent is paid with the intrinsic reward alone and
    learns from detached features; the encoder learns from the self-supervised loss alone, on batches of one domain at a
    time. Which reward and agent, and when each is updated, is the method's (see
    :class:`~crptpro.objectives.ExplorationDefaults`) unless ``config`` says otherwise.

    Deviation: neither the paper nor the released code says how its cross-domain active baselines are built. Turns,
    shared candidates and schedules in a domain's own decisions are this project's choice.

    With ``run_dir`` the run can be killed at any moment: the same call with a newly built loss continues from the last
    checkpoint and, on the CPU, gives the same numbers as an uninterrupted one. An episode that was under way is played
    again from its seed and actions.

    Args:
        loss: the objective with its networks; trained in place. Its ``training_record`` afterwards says how. Built by
            hand, it has the name of the method that it explores as from here on.
        domains: one or several, by domain or task name.
        run_dir: records (``pretrain.csv``, ``explore.csv``, ``episodes.csv``), replays and checkpoints; ``None`` keeps
            nothing but the result.
        config: every number.
        logger: used instead of a local record in ``run_dir``.
        resume: continue what ``run_dir`` holds; ``False`` refuses a directory that holds a run.
        progress: show a bar (lines in log files).
        env_factory: makes the environments; called as :func:`~crptpro.envs.make_env` is, in threads of their own.
        **overrides: single settings of :class:`~crptpro.training.ActiveConfig`, e.g. ``env_steps=50_000``.

    Returns:
        Metrics, verdict on collapse, budgets spent, and the actors.

    Raises:
        CRPTproError: a single-domain method was given several domains, the loss does not suffice for the reward,
            the budget is too small for any update, or the device cannot be used.
        CheckpointError: if ``run_dir`` holds a run with other settings (named).
        NonFiniteError: if a loss or a policy became NaN or infinite; the last checkpoint is kept.
        DiskSpaceError: if the disk cannot hold the replays.
    """
    config = dataclasses.replace(config or ActiveConfig(), **overrides)
    device = usable_device(config.device)
    _name(loss)
    defaults, exploration = method_defaults(loss), exploration_defaults(loss)
    config = resolve(config, exploration, defaults)
    _warn_of_another_encoder(loss)
    warn_of_unread(config, exploration)
    named = domain_names(loss, domains, exploration)
    loss.to(device).train()
    with contextlib.ExitStack() as stack:
        stack.enter_context(kept_global_rng())
        require_explorable(loss, domains, config)
        torch.manual_seed(derive_seed(config.seed, "active", "loss"))
        directory = Path(run_dir or stack.enter_context(tempfile.TemporaryDirectory(prefix="crptpro-")))
        stack.enter_context(DirectoryLock(directory, error=CheckpointError, is_reentrant=True))
        checkpoints = None if run_dir is None else CheckpointDir(directory / "checkpoints")
        if not resume and checkpoints is not None and checkpoints.latest_counter() is not None:
            raise CheckpointError(f"{run_dir} already holds a run. Choose another directory, or resume it.")
        if run_dir is not None and logger is None:
            logger = stack.enter_context(RunLogger(directory, config=config))
        state = None if checkpoints is None else checkpoints.load_latest()
        dtype = resolve_precision(precision_to_continue(config.precision, state), config.device)
        channels_last = resolve_channels_last(config.channels_last)
        stack.enter_context(computing(loss, dtype, channels_last=channels_last))
        now = fingerprint(loss, list(named), config, defaults, dtype)
        finished = None
        if state is not None:
            # Before environments and replays are made.
            require_same(_with_name(state["fingerprint"], loss), now, directory)
            finished = action_sizes(state) if state["is_finished"] else None
        else:
            shutil.rmtree(directory / DIRECTORY, ignore_errors=True)  # of an attempt without a checkpoint
        run = assemble(
            loss,
            named,
            config,
            defaults,
            exploration,
            run_dir=directory,
            dtype=dtype,
            records=logger,
            checkpoints=checkpoints,
            env_factory=env_factory,
            finished=finished,
        )
        stack.callback(run.close)
        run.resume(state)
        run.train(progress=progress)
        metrics, verdict = run.finish()
        loss.training_record = training_record(
            loss,
            updates=run.updates,
            seconds=run.seconds,
            precision=run.precision,
            channels_last=is_channels_last(loss),
            device=str(device),
            env_steps=run.env_steps,
            settings={key: value for key, value in run.fingerprint.items() if key != "loss"},
            datasets=[
                {"domain": m.name, "agent_steps": m.agent_steps, "episodes": m.episodes} for m in run.members
            ],
            metrics=metrics,
            collapse=verdict,
            made_with=run.made_with,
        )
        return ActiveResult(
            updates=run.updates,
            resumed_from=run.resumed_from,
            seconds=run.seconds,
            precision=run.precision,
            metrics=metrics,
            collapse=verdict,
            history=run.history,
            run_dir=None if run_dir is None else Path(run_dir),
            env_steps=run.env_steps,
            actors={member.name: member.agent.actor for member in run.members},
        )


def _name(loss: LossModule) -> None:
    """Let a loss built by hand bear the name of the method that it explores as: its artifact's, too."""
    method = exploring_method(loss)
    if getattr(loss, "method_name", None) is None and method is not None and method.loss_class is type(loss):
        loss.method_name = method.name


def _with_name(saved: dict[str, Any], loss: LossModule) -> dict[str, Any]:
    """Complete the fingerprint of an earlier version, which did not name a loss built by hand."""
    method = exploring_method(type(loss))
    if method is None or method.loss_class is not type(loss):
        return saved
    return {**saved, "loss": {"method_name": method.name, **saved["loss"]}}


def _warn_of_another_encoder(loss: LossModule) -> None:
    """A method's numbers belong to its own pixel scaling; a loss built by hand may have forgotten it."""
    name = method_name_of(loss)
    config = getattr(getattr(loss, "encoder", None), "config", {})
    wanted = get_method(name).encoder_options if name in methods(presets=True) else {}
    for option, value in wanted.items():
        if option in config and _plain(config[option]) != _plain(value):
            _LOG.warning(
                "%s wants an encoder with %s %s, this one has %s; get_method(%r).build_encoder() builds its own.",
                name, option, value, config[option], name,
            )  # fmt: skip


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value

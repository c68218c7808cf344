"""Build what an active pre-training is made of, from a loss, domains and settings."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.domains import Domain, get_domain
from crptpro.envs import make_env
from crptpro.loggers import RunLogger
from crptpro.modules import is_channels_last
from crptpro.objectives import ExplorationDefaults, MethodDefaults
from crptpro.seeding import derive_seed
from crptpro.training.action_repeat import action_repeat_of
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.env_thread import EnvThread, runs_ahead
from crptpro.training.explore.agents import build_agent
from crptpro.training.explore.batches import ReplayBatches
from crptpro.training.explore.member import Member
from crptpro.training.explore.plan import Plan, make_plan
from crptpro.training.explore.replays import DIRECTORY, make_replay, require_room
from crptpro.training.explore.rewards import ExplorationReward
from crptpro.training.explore.run import ActiveRun
from crptpro.training.fingerprint import describe_loss
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.window import num_prototypes
from crptpro.transforms.prototype_reward import warn_if_mostly_zero

logger = logging.getLogger(__name__)

FREE_TO_CHANGE = ("device", "precision", "channels_last", "render_ahead")
"""Settings that a run may be continued with other values of; what `precision` and `channels_last` became is compared
instead."""


def assemble(
    loss: LossModule,
    domains: dict[str, str | Domain],
    config: ActiveConfig,
    defaults: MethodDefaults,
    exploration: ExplorationDefaults,
    *,
    run_dir: Path,
    dtype: torch.dtype,
    records: RunLogger | None,
    checkpoints: CheckpointDir | None,
    env_factory: Callable[..., EnvBase],
    finished: Mapping[str, int] | None = None,
) -> ActiveRun:
    """Build a run; nothing is left open if that fails.

    Args:
        loss: on the device, in its compute dtype.
        domains: by name, in the order of their turns.
        config: resolved.
        defaults: how the method trains its encoder.
        exploration: how it explores.
        run_dir: replays go below it.
        dtype: of the big products.
        records: where rows go.
        checkpoints: where the run is kept.
        env_factory: makes the environments.
        finished: action sizes of a run that has spent its budget: it needs neither environments nor replays.
    """
    repeats = {name: action_repeat_of(domain, config.action_repeat) for name, domain in domains.items()}
    plan = make_plan(config, list(repeats.values()))
    if finished is None:
        _announce(plan, config, list(domains))
        require_room(loss, config, plan, len(domains), run_dir)
    if finished is None and config.reward == "prototype":
        warn_if_mostly_zero(num_prototypes(loss) or 0, config.batch_size or 1, config.knn_k or 3)
    device = torch.device(config.device)
    members: list[Member] = []
    batches: list[ReplayBatches] = []
    rewards: list[ExplorationReward] = []
    with contextlib.ExitStack() as unfinished:
        for name, domain in domains.items():
            seed = derive_seed(config.seed, "active", name)
            env, replay = None, None
            if finished is None:
                env = _make_env_thread(loss, domain, config, repeats[name], seed, env_factory)
                unfinished.callback(env.close)
                replay = make_replay(env.env, config, plan, run_dir / DIRECTORY / name)
            action_dim = (finished or {})[name] if env is None else env.env.action_spec.shape[-1]
            torch.manual_seed(derive_seed(seed, "agent"))  # a domain's networks do not depend on its company
            agent = build_agent(
                config,
                feature_dim=loss.encoder.feature_dim,
                action_dim=action_dim,
                generator=torch.Generator().manual_seed(derive_seed(seed, "policy")),
                dtype=dtype,
            )
            members.append(
                Member(
                    name,
                    env,
                    replay,
                    agent,
                    action_dim=action_dim,
                    seed=seed,
                    random_agent_steps=plan.random_agent_steps,
                    skill_dim=config.skill_dim,
                    skill_agent_steps=config.skill_agent_steps or 1,
                )
            )
            if replay is not None:
                batches.append(
                    ReplayBatches(
                        replay,
                        seed=derive_seed(seed, "batches"),
                        pad=config.shift_pad,
                        device=device,
                        views={**agent.views, **getattr(loss, "views", {})},
                        n_step=config.n_step or 1,
                        discount=config.discount,
                    )
                )
            if config.per_domain_queue or not rewards or not rewards[0].keeps_candidates:
                rewards.append(
                    ExplorationReward(config.reward or "", loss, config, seed=derive_seed(seed, "reward"))
                )
            else:
                rewards.append(rewards[0])
        torch.manual_seed(derive_seed(config.seed, "active", "loss"))
        run = ActiveRun(
            loss,
            Learner(
                loss,
                defaults,
                learning_rate=config.learning_rate or defaults.lr,
                encoder_tau=defaults.encoder_tau,
                updates=plan.encoder_updates,
            ),
            members,
            batches,
            rewards,
            plan=plan,
            encodes_before_update=exploration.encodes_before_update,
            config=config,
            fingerprint=fingerprint(loss, list(domains), config, defaults, dtype),
            precision="bf16" if dtype == torch.bfloat16 else "fp32",
            records=records,
            checkpoints=checkpoints,
            run_dir=run_dir,
        )
        unfinished.pop_all()
    return run


def _announce(plan: Plan, config: ActiveConfig, domains: list[str]) -> None:
    logger.info(
        "active pre-training: %s env steps over %s (%s decisions in each, the first %s random), %s encoder updates of "
        "batch %s; reward %s, explorer %s",
        f"{plan.env_steps:,}", ", ".join(domains), f"{plan.agent_steps:,}", f"{plan.random_agent_steps:,}",
        f"{plan.encoder_updates:,}", config.batch_size, config.reward, config.agent,
    )  # fmt: skip


def _make_env_thread(
    loss: LossModule,
    domain: str | Domain,
    config: ActiveConfig,
    action_repeat: int,
    seed: int,
    env_factory: Callable[..., EnvBase],
) -> EnvThread:
    encoder = loss.encoder
    make_this_env = functools.partial(
        env_factory,
        get_domain(domain) if env_factory is make_env else domain,
        seed=seed,
        quality=config.quality,
        action_repeat=action_repeat,
        image_size=getattr(encoder, "image_size", 84),
        frame_stack=getattr(encoder, "in_channels", 9) // 3,
    )
    return EnvThread(make_this_env, is_ahead=runs_ahead(domain, config))


def fingerprint(
    loss: LossModule, domains: list[str], config: ActiveConfig, defaults: MethodDefaults, dtype: torch.dtype
) -> dict:
    """Return everything that must agree for a checkpoint to be continued."""
    settings = dataclasses.asdict(config)
    for name in FREE_TO_CHANGE:
        settings.pop(name)
    if not is_channels_last(loss):  # only then: runs from before this switch can be continued
        settings["channels_last"] = False
    return {
        "domains": domains,
        **settings,
        "precision": "bf16" if dtype == torch.bfloat16 else "fp32",
        "training": dataclasses.asdict(defaults),
        "loss": describe_loss(loss),
    }

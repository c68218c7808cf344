"""Build what an active pre-training is made of, from a loss, domains and settings."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.data import FrameReplay
from crptpro.domains import Domain, get_domain
from crptpro.envs import make_env, resolve_action_repeat
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.loggers import RunLogger
from crptpro.objectives import ExplorationDefaults, MethodDefaults, exploration_defaults, method_defaults
from crptpro.seeding import derive_seed
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.env_thread import EnvThread, runs_ahead
from crptpro.training.explore.agents import build_agent, require_agent
from crptpro.training.explore.batches import ReplayBatches
from crptpro.training.explore.member import Member
from crptpro.training.explore.plan import Plan, make_plan, resolve
from crptpro.training.explore.rewards import ExplorationReward, build_reward
from crptpro.training.explore.run import ActiveRun
from crptpro.training.fingerprint import describe_loss
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.window import num_prototypes
from crptpro.transforms.prototype_reward import warn_if_mostly_zero

logger = logging.getLogger(__name__)

FREE_TO_CHANGE = ("device", "precision", "render_ahead")
"""Settings that a run may be continued with other values of; what `precision` became is compared instead."""


def domain_names(
    loss: LossModule, domains: str | Domain | Sequence[str | Domain], exploration: ExplorationDefaults
) -> dict[str, str | Domain]:
    """Name the domains of a run.

    Returns:
        Domain name to what an environment is made of.

    Raises:
        CRPTproError: none, one twice, or several for a method that explores one.
    """
    listed = [domains] if isinstance(domains, (str, Domain)) else list(domains)
    named: dict[str, str | Domain] = {}
    for domain in listed:
        try:
            name = get_domain(domain).name
        except UnknownNameError:  # a caller's own factory may know it; the library's says what is near
            name = str(domain)
        if name in named:
            raise CRPTproError(f"The domain {name!r} is named twice; each has one agent.")
        named[name] = domain
    if not named:
        raise CRPTproError("Name at least one domain to explore.")
    if exploration.is_single_domain and len(named) > 1:
        method = getattr(loss, "method_name", None) or type(loss).__name__
        raise CRPTproError(
            f"{method} pre-trains on one domain, got {len(named)} ({', '.join(named)}). Run it once per domain, or use "
            "the method's cross-domain variant (-c)."
        )
    return named


def require_explorable(
    loss: LossModule, domains: str | Domain | Sequence[str | Domain], config: ActiveConfig
) -> None:
    """Refuse what cannot run, before anything is written.

    Args:
        loss: to be pre-trained.
        domains: to be explored.
        config: what was asked for.

    Raises:
        CRPTproError: several domains for a method of one, an unknown reward or agent, a reward that the loss does not
            suffice for, or a budget too small for any update.
        ValueError: a setting that reward or agent refuses.
    """
    exploration = exploration_defaults(loss)
    config = resolve(config, exploration, method_defaults(loss))
    named = domain_names(loss, domains, exploration)
    make_plan(config, [_action_repeat(domain, config.action_repeat) for domain in named.values()])
    require_agent(config.agent)
    build_reward(config.reward or "", loss, config, torch.Generator())


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
    """
    repeats = {name: _action_repeat(domain, config.action_repeat) for name, domain in domains.items()}
    plan = make_plan(config, list(repeats.values()))
    _announce(plan, config, list(domains))
    if config.reward == "prototype":
        warn_if_mostly_zero(num_prototypes(loss) or 0, config.batch_size or 1, config.knn_k or 3)
    device = torch.device(config.device)
    members: list[Member] = []
    batches: list[ReplayBatches] = []
    rewards: list[ExplorationReward] = []
    with contextlib.ExitStack() as unfinished:
        for name, domain in domains.items():
            seed = derive_seed(config.seed, "active", name)
            env = _make_env_thread(loss, domain, config, repeats[name], seed, env_factory)
            unfinished.callback(env.close)
            replay = _make_replay(env.env, config, plan, run_dir / "replay" / name, records)
            torch.manual_seed(derive_seed(seed, "agent"))  # a domain's networks do not depend on its company
            agent = build_agent(
                config,
                feature_dim=loss.encoder.feature_dim,
                action_dim=env.env.action_spec.shape[-1],
                generator=torch.Generator().manual_seed(derive_seed(seed, "policy")),
                dtype=dtype,
            )
            members.append(
                Member(
                    name,
                    env,
                    replay,
                    agent,
                    seed=seed,
                    random_agent_steps=plan.random_agent_steps,
                    skill_dim=config.skill_dim,
                    skill_agent_steps=config.skill_agent_steps or 1,
                )
            )
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
            fingerprint=_fingerprint(loss, list(domains), config, defaults, dtype),
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


def _make_replay(
    env: EnvBase, config: ActiveConfig, plan: Plan, path: Path, records: RunLogger | None
) -> FrameReplay:
    """Make a domain's replay no longer than it can get; what a checkpoint refers to must outlive the next two."""
    channels, height, width = env.observation_spec["pixels"].shape
    capacity = min(config.replay_capacity or plan.agent_steps, plan.agent_steps)
    wraps = capacity < plan.agent_steps
    slack = 2 * (config.checkpoint_interval_env_steps // sum(plan.repeats)) + 2_000 if wraps else 0
    columns = {} if config.skill_dim is None else {"skill": ((config.skill_dim,), torch.float32)}
    replay = FrameReplay(
        capacity,
        frame_shape=(3, height, width),
        action_dim=env.action_spec.shape[-1],
        path=path,
        slack=slack,
        frame_stack=channels // 3,
        extra_columns=columns,
    )
    logger.info(
        "replay of %s: up to %.2g GB in %s", path.name, replay.frame_slots * 3 * height * width / 1e9, path
    )
    return replay


def _fingerprint(
    loss: LossModule, domains: list[str], config: ActiveConfig, defaults: MethodDefaults, dtype: torch.dtype
) -> dict:
    settings = dataclasses.asdict(config)
    for name in FREE_TO_CHANGE:
        settings.pop(name)
    return {
        "domains": domains,
        **settings,
        "precision": "bf16" if dtype == torch.bfloat16 else "fp32",
        "training": dataclasses.asdict(defaults),
        "loss": describe_loss(loss),
    }


def _action_repeat(domain: str | Domain, asked: int | None) -> int:
    try:
        return resolve_action_repeat(domain, asked)
    except UnknownNameError:  # an `env_factory` of the caller's may know names that the library does not
        return asked or 2

"""What is asked of an active pre-training: checked before anything is written."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence

import torch
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.domains import Domain, get_domain
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.objectives import ExplorationDefaults, exploration_defaults, method_defaults
from crptpro.training.action_repeat import action_repeat_of
from crptpro.training.explore.agents import require_agent
from crptpro.training.explore.plan import make_plan, resolve
from crptpro.training.explore.rewards import build_reward

logger = logging.getLogger(__name__)

_READ_BY = {
    "knn_k": ("prototype", "particle"),
    "queue_size": ("prototype",),
    "per_domain_queue": ("prototype",),
    "skill_dim": ("skill-contrast", "skill-ddpg"),
    "skill_agent_steps": ("skill-contrast", "skill-ddpg"),
    "initial_temperature": ("rad-sac", "averaged-sac"),
}
"""Settings that only some of the library's own rewards and agents read; one of a caller's own may read any."""

_PLAIN_NAME = re.compile(r"\w[\w.:+-]*")


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
        if not _PLAIN_NAME.fullmatch(name):
            raise CRPTproError(
                f"The domain {name!r} cannot name a directory and a column; use letters, digits and . : _ + - only."
            )
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
    make_plan(config, [action_repeat_of(domain, config.action_repeat) for domain in named.values()])
    require_agent(config.agent)
    if (config.replay_capacity or 1) <= (config.n_step or 1):
        raise CRPTproError(
            f"A replay of {config.replay_capacity} transitions holds no n_step of {config.n_step}; use a larger "
            "replay_capacity."
        )
    if config.reward == "skill-contrast" and config.skill_dim is None:
        raise CRPTproError("The reward skill-contrast needs skills; set skill_dim (BeCL: 16).")
    build_reward(config.reward or "", loss, config, torch.Generator())


def warn_of_unread(config: ActiveConfig, exploration: ExplorationDefaults) -> None:
    """Say which settings neither reward nor explorer looks at; one configuration may serve several methods.

    Args:
        config: resolved.
        exploration: how the method explores.
    """
    own = {name for readers in _READ_BY.values() for name in readers}
    if not {config.reward, config.agent} <= own:
        return
    for name, readers in _READ_BY.items():
        value = getattr(config, name)
        usual = (getattr(ActiveConfig, name), getattr(exploration, name, None))
        if value not in usual and not {config.reward, config.agent} & set(readers):
            logger.warning(
                "`%s` %s changes nothing: neither the reward %s nor the explorer %s reads it, only %s.",
                name, value, config.reward, config.agent, " and ".join(readers),
            )  # fmt: skip

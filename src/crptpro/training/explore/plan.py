"""How many decisions and updates an active pre-training makes, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from crptpro.active_config import ActiveConfig
from crptpro.errors import CRPTproError
from crptpro.objectives import ExplorationDefaults, MethodDefaults


def resolve(config: ActiveConfig, exploration: ExplorationDefaults, defaults: MethodDefaults) -> ActiveConfig:
    """Fill in what is left to the method; afterwards only ``action_repeat``, ``skill_dim`` and ``knn_k`` may be unset.

    Args:
        config: what was asked for.
        exploration: how the method explores.
        defaults: how it trains its encoder.
    """
    names = (
        "env_steps", "reward", "agent", "encoder_update_interval", "encoder_updates_each", "agent_update_interval",
        "random_agent_steps", "replay_capacity", "n_step", "skill_dim", "skill_agent_steps",
    )  # fmt: skip
    chosen = {name: getattr(exploration, name) for name in names if getattr(config, name) is None}
    if config.batch_size is None:
        chosen["batch_size"] = defaults.batch_size
    if config.learning_rate is None:
        chosen["learning_rate"] = defaults.lr
    return replace(config, **chosen)


@dataclass(frozen=True)
class Plan:
    """Who decides when, and which decisions come with updates.

    Attributes:
        repeats: simulator steps per decision, of each domain in the order of turns.
        agent_steps: decisions of each domain.
        random_agent_steps: of these, at random.
        first_update: decision of a domain from which on updates come with it: there is something to learn from then.
        encoder_update_interval: of a domain's own decisions.
        encoder_updates_each: encoder updates every time.
        agent_update_interval: of a domain's own decisions.
    """

    repeats: tuple[int, ...]
    agent_steps: int
    random_agent_steps: int
    first_update: int
    encoder_update_interval: int
    encoder_updates_each: int
    agent_update_interval: int

    @property
    def decisions(self) -> int:
        """Over all domains."""
        return self.agent_steps * len(self.repeats)

    @property
    def env_steps(self) -> int:
        """Simulator steps over all domains."""
        return self.env_steps_after(self.decisions)

    @property
    def encoder_updates(self) -> int:
        """Over all domains."""
        interval = self.encoder_update_interval
        turns = -(-self.agent_steps // interval) - -(-self.first_update // interval)
        return max(0, turns) * self.encoder_updates_each * len(self.repeats)

    def env_steps_after(self, decisions: int) -> int:
        """Simulator steps that so many decisions, taken in turn, amount to."""
        rounds, rest = divmod(decisions, len(self.repeats))
        return rounds * sum(self.repeats) + sum(self.repeats[:rest])

    def trains_encoder(self, agent_step: int) -> bool:
        """Whether a domain's decision number ``agent_step`` (from 0) comes with encoder updates."""
        return agent_step >= self.first_update and agent_step % self.encoder_update_interval == 0

    def trains_agent(self, agent_step: int) -> bool:
        """Whether a domain's decision number ``agent_step`` (from 0) comes with an update of its agent."""
        return agent_step >= self.first_update and agent_step % self.agent_update_interval == 0


def make_plan(config: ActiveConfig, repeats: Sequence[int]) -> Plan:
    """Spread a budget over domains, as equally many decisions in each: they take turns.

    Args:
        config: resolved.
        repeats: simulator steps per decision, of each domain.

    Raises:
        CRPTproError: if the budget ends before the first update of encoder or agent.
    """
    assert config.env_steps is not None
    share = sum(repeats) if config.steps_budget == "total" else max(repeats)
    plan = Plan(
        repeats=tuple(repeats),
        agent_steps=-(-config.env_steps // share),
        random_agent_steps=config.random_agent_steps or 0,
        first_update=max(config.random_agent_steps or 0, config.n_step or 1),
        encoder_update_interval=config.encoder_update_interval or 1,
        encoder_updates_each=config.encoder_updates_each or 1,
        agent_update_interval=config.agent_update_interval or 1,
    )
    if plan.encoder_updates == 0 or not any(map(plan.trains_agent, range(plan.agent_steps))):
        raise CRPTproError(
            f"{config.env_steps:,} env steps are {plan.agent_steps:,} decisions per domain, of which the first "
            f"{plan.random_agent_steps:,} are random: no update of encoder or explorer would ever happen. Ask for more "
            "env_steps, fewer random_agent_steps or shorter intervals."
        )
    return plan

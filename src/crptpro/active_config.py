"""Every number of active pre-training; what a method decides is left to it unless set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from crptpro.quality import Quality
from crptpro.switches import Switch, check_switch


@dataclass(frozen=True)
class ExplorationSettings:
    """How agents explore while an encoder is pre-trained: what defines the run, wherever it runs.

    Source: Proto-RL's released agent (denisyarats/proto) and CRPTpro's comparison of it across domains.

    ``None`` means the method's own value (``crptpro.objectives.get_method(name).exploration``). ``env_steps`` count
    un-repeated simulator steps, ``agent_steps`` decisions; every interval is in a domain's own decisions, so that no
    domain is left out whatever their number.
    """

    env_steps: int | None = None
    """budget in simulator steps (default: the method's)"""
    steps_budget: Literal["total", "per_domain"] = "total"
    """total: all domains share the budget; per_domain: the domain of the largest action repeat has all of it, and every
    other one as many decisions"""
    reward: str | None = None
    """what exploration is paid with: prototype, particle, skill-contrast, or one of your own (default: the method's)"""
    agent: str | None = None
    """what explores: rad-sac, averaged-sac or skill-ddpg (default: the method's)"""
    action_repeat: int | None = None
    """simulator steps per decision (default: each domain's, 2)"""
    encoder_update_interval: int | None = None
    """decisions in a domain between two encoder updates on it (default: the method's, 2)"""
    encoder_updates_each: int | None = None
    """encoder updates every time, each on a batch of its own (default: the method's; becl 3, others 1)"""
    agent_update_interval: int | None = None
    """decisions in a domain between two updates of its agent (default: the method's)"""
    random_agent_steps: int | None = None
    """decisions per domain taken uniformly at random before its first update (default: the method's)"""
    replay_capacity: int | None = None
    """transitions kept per domain, fewer where episodes have less than 50 decisions (default: the method's, 100,000)"""
    n_step: int | None = None
    """decisions that the agent's return looks ahead (default: the method's)"""
    skill_dim: int | None = None
    """number of skills; none without (default: the method's; becl 16)"""
    skill_agent_steps: int | None = None
    """decisions that a skill is kept for (default: the method's)"""
    bottleneck_dim: int = 50
    """width that actor and critic first reduce the features to"""
    hidden_dim: int = 1024
    """width of the two hidden layers of actor and critic"""
    discount: float = 0.99
    """per decision"""
    agent_learning_rate: float = 1e-4
    """of the agents' Adam optimisers"""
    initial_temperature: float = 0.1
    """SAC's alpha at the start; skill-ddpg has none"""
    critic_tau: float = 0.01
    """share of the critic that enters its target at each target update"""
    shift_pad: int = 4
    """random shift of at most so many pixels in each direction"""
    knn_k: int | None = None
    """the reward's number of neighbours (default: prototype 3, particle 12)"""
    queue_size: int = 2_048
    """candidates that the prototype reward keeps, a multiple of the number of prototypes"""
    per_domain_queue: bool = False
    """candidates of the prototype reward for every domain instead of one queue for all, which the artifact hands to
    downstream runs; a running scale is always a domain's own"""
    checkpoint_interval_env_steps: int = 5_000
    """simulator steps, over all domains, between two checkpoints"""
    quality: Quality = "exact"
    """render quality"""

    def __post_init__(self) -> None:
        """Refuse values that cannot run.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        for name in (
            "env_steps", "action_repeat", "encoder_update_interval", "encoder_updates_each", "agent_update_interval",
            "replay_capacity", "n_step", "skill_dim", "skill_agent_steps", "bottleneck_dim", "hidden_dim", "knn_k",
            "queue_size", "checkpoint_interval_env_steps",
        ):  # fmt: skip
            _require(self, name, "at least 1", lambda value: value >= 1)
        for name in ("discount", "critic_tau"):
            _require(self, name, "in [0, 1]", lambda value: 0 <= value <= 1)
        for name in ("agent_learning_rate", "initial_temperature"):
            _require(self, name, "positive", lambda value: value > 0)
        for name in ("random_agent_steps", "shift_pad"):
            _require(self, name, "0 or more", lambda value: value >= 0)


@dataclass(frozen=True)
class ActiveConfig(ExplorationSettings):
    """Every setting of active pre-training: how it explores, how the encoder learns, and where and how it runs."""

    batch_size: int | None = None
    """transitions per update, of encoder and agent alike (default: the method's)"""
    learning_rate: float | None = None
    """of the encoder's Adam (default: the method's)"""
    log_interval: int = 50
    """encoder updates between two rows of the record"""
    patience_updates: int = 5_000
    """length of a plateau after which the run is called dead"""
    seed: int = 0
    """seeds agents, environments, exploration, sampling and shifts"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the convolutions and big matrix products; `auto` is bf16 where the hardware is faster in it.
    Deviation: the released code computes in fp32 throughout, which `fp32` gives"""
    channels_last: Switch = "auto"
    """memory layout of the encoder's convolutions; changes rounding only (auto: on)"""
    device: str = "cpu"
    """where networks live"""
    render_ahead: bool | None = None
    """draw a domain's next observation in another thread while other work goes on; by default where it pays"""

    def __post_init__(self) -> None:
        """Refuse values that cannot run.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        super().__post_init__()
        check_switch("channels_last", self.channels_last)
        for name in ("batch_size", "log_interval", "patience_updates"):
            _require(self, name, "at least 1", lambda value: value >= 1)
        _require(self, "learning_rate", "positive", lambda value: value > 0)
        _require(self, "seed", f"from 0 to {2**32 - 1}", lambda value: 0 <= value < 2**32)


def _require(
    settings: ExplorationSettings, name: str, allowed: str, is_allowed: Callable[[Any], bool]
) -> None:
    value = getattr(settings, name)
    if value is not None and not is_allowed(value):
        raise ValueError(f"`{name}` must be {allowed}, got {value}.")

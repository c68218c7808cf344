"""How a method explores while it pre-trains actively."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExplorationDefaults:
    """Active pre-training of a method unless the caller says otherwise; the values here are Proto-RL's.

    Every interval counts a domain's own agent steps, so that no domain is starved whatever their number.

    Raises:
        ValueError: a count or interval below 1, or fewer than two skills.
    """

    reward: str = "prototype"
    """Intrinsic reward that alone drives the exploration: ``"prototype"``, ``"particle"``, ``"skill-contrast"``."""

    agent: str = "rad-sac"
    """Exploring agent: ``"rad-sac"``, ``"averaged-sac"`` (DrQ's K = M = 2 on detached features), ``"skill-ddpg"``."""

    env_steps: int = 200_000
    """Simulator steps: in total over the domains of a group, or of the one domain. The random phases come out of them,
    so there are a few per cent fewer encoder updates than the steps would allow."""

    is_single_domain: bool = False
    """The (S) variants: pre-trained on one domain only."""

    encoder_update_interval: int = 2
    """Agent steps between two encoder updates."""

    encoder_updates_each: int = 1
    """Encoder updates every time, each on a fresh batch."""

    agent_update_interval: int = 1
    """Agent steps between two updates of the agent."""

    encodes_before_update: bool = False
    """Whether reward and agent see the features from before the encoder update of the same turn, not after it."""

    transfers_actor: bool = False
    """Whether the downstream agent starts from the exploring actor."""

    n_step: int = 1
    """Agent steps from an observation to the "next" one in the agent's and the encoder's batches."""

    skill_dim: int | None = None
    """Number of skills; None for an agent without skills."""

    skill_agent_steps: int = 50
    """Agent steps that a skill is kept."""

    replay_capacity: int = 100_000
    """Transitions kept per domain."""

    random_agent_steps: int = 1_000
    """Agent steps of uniformly random actions per domain, before its updates start."""

    def __post_init__(self) -> None:
        counts = (
            "env_steps", "encoder_update_interval", "encoder_updates_each", "agent_update_interval", "n_step",
            "skill_agent_steps", "replay_capacity",
        )  # fmt: skip
        for name in counts:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
        if self.random_agent_steps < 0:
            raise ValueError(f"random_agent_steps must not be negative, got {self.random_agent_steps}.")
        if self.skill_dim is not None and self.skill_dim < 2:
            raise ValueError(f"skill_dim must be at least 2, or None for no skills, got {self.skill_dim}.")

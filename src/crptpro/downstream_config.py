"""Every number of the downstream stage, with the paper's values as defaults."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from crptpro.colors import Colors
from crptpro.quality import Quality
from crptpro.switches import Switch, check_switch

Algorithm = Literal["rad-sac", "drq", "skill-ddpg"]


@dataclass(frozen=True)
class SkillDDPGSettings:
    """What `skill-ddpg` alone reads: BeCL's own agent, DDPG with a skill that is fixed downstream.

    Source: rll-research/url_benchmark ``agent/ddpg.py``; Rooshy-yang/BeCL.
    """

    skill_dim: int = 16
    """number of skills"""
    skill: int | None = None
    """which one is learned with, from 0 (default: drawn from the seed)"""
    n_step: int = 3
    """agent steps whose rewards are summed before the critic's value takes over"""
    update_interval: int = 2
    """agent steps between two updates"""
    noise_std: float = 0.2
    """standard deviation of the noise on every action that is not evaluated"""
    noise_clip: float = 0.3
    """largest noise on actions that are learned from"""

    def __post_init__(self) -> None:
        """Refuse values that cannot run.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        for name in ("skill_dim", "n_step", "update_interval"):
            if getattr(self, name) < 1:
                raise ValueError(f"`skill_ddpg.{name}` must be at least 1, got {getattr(self, name)}.")
        for name in ("noise_std", "noise_clip"):
            if getattr(self, name) < 0:
                raise ValueError(f"`skill_ddpg.{name}` must not be negative, got {getattr(self, name)}.")
        if self.skill is not None and not 0 <= self.skill < self.skill_dim:
            raise ValueError(
                f"`skill_ddpg.skill` must be in 0..{self.skill_dim - 1} (`skill_dim` is {self.skill_dim}), "
                f"got {self.skill}."
            )


@dataclass(frozen=True)
class SACSettings:
    """SAC on a frozen encoder: what defines the learner and its budget, wherever it runs.

    Source: CRPTpro, hyper-parameter table; Proto-RL's released agent.

    One update per agent step once ``random_agent_steps`` transitions are stored. ``env_steps`` counts
    un-repeated simulator steps, ``agent_steps`` decisions. The defaults are those of `rad-sac`;
    :func:`drq_settings` and :func:`skill_ddpg_settings` hold the other algorithms'.
    """

    algorithm: Algorithm = "rad-sac"
    """`rad-sac`: SAC on a frozen encoder; `drq`: SAC that trains its encoder itself, from scratch; `skill-ddpg`: BeCL's
    own agent on a frozen encoder"""
    env_steps: int = 500_000
    """budget in simulator steps; an episode still running then is cut"""
    action_repeat: int | None = None
    """simulator steps per decision (default: the domain's, 2)"""
    batch_size: int = 512
    """transitions per update"""
    replay_capacity: int | None = None
    """transitions kept; the oldest go first (default: the method's that trained the encoder; proto-rl 100,000, all
    others 40,000)"""
    random_agent_steps: int = 1_000
    """decisions taken uniformly at random before the first update (by the policy, if it was transferred)"""
    transfer_actor: bool | None = None
    """start from the actor that explored during pre-training. Left to itself rad-sac does where the artifact has one of
    the task's domain, which proto-rl-s leaves"""
    bottleneck_dim: int = 50
    """width that actor and critic first reduce the features to"""
    hidden_dim: int = 1024
    """width of the two hidden layers of actor and critic"""
    discount: float = 0.99
    """per agent step; only true terminations stop bootstrapping, time limits never do"""
    learning_rate: float = 1e-4
    """of the Adam optimisers (actor, critic, temperature)"""
    initial_temperature: float = 0.1
    """SAC's alpha at the start (not of skill-ddpg)"""
    actor_update_interval: int = 2
    """updates between two actor and temperature steps (of skill-ddpg: every update)"""
    critic_tau: float = 0.01
    """share of the critic that enters its target at each target update"""
    target_update_interval: int = 2
    """updates between two target updates (of skill-ddpg: every update)"""
    shift_pad: int = 4
    """random shift of at most so many pixels in each direction"""
    intrinsic_reward_coef: float = 0.2
    """weight of the prototype-kNN bonus (the paper's beta), which rad-sac alone has; 0 switches it off"""
    knn_k: int = 3
    """the bonus is the distance to the k-th nearest candidate"""
    queue_size: int = 2_048
    """candidates kept, a multiple of the number of prototypes"""
    reset_queue: bool = False
    """start with an empty candidate queue although the artifact brings one"""
    eval_interval_env_steps: int = 10_000
    """simulator steps between two evaluations; the first is at 0, the last at the end"""
    eval_episodes: int = 10
    """episodes per evaluation"""
    video_episodes: int = 0
    """episodes per evaluation that are written as video (needs the `video` extra)"""
    checkpoint_interval_env_steps: int = 5_000
    """simulator steps between two checkpoints, taken at episode ends"""
    log_interval_env_steps: int = 1_000
    """simulator steps between two rows of training metrics"""
    features: Literal["auto", "dense", "reencode"] = "auto"
    """how shifted features are had: cut from dense maps stored once per observation, or encoded at every update (drq
    encodes, whatever is said here)"""
    dense_precision: Literal["auto", "bf16"] = "auto"
    """number format of the dense maps: `auto` is that of `precision`; bf16 halves their memory where networks compute
    in fp32, and rounds every feature to eight significant bits"""
    skill_ddpg: SkillDDPGSettings = field(default_factory=SkillDDPGSettings)
    """what skill-ddpg alone reads"""

    def __post_init__(self) -> None:
        """Refuse values that cannot run.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        for name in (
            "env_steps", "action_repeat", "batch_size", "replay_capacity", "random_agent_steps", "bottleneck_dim",
            "hidden_dim", "actor_update_interval", "target_update_interval", "knn_k", "queue_size",
            "eval_interval_env_steps", "eval_episodes", "checkpoint_interval_env_steps", "log_interval_env_steps",
        ):  # fmt: skip
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"`{name}` must be at least 1, got {getattr(self, name)}.")
        for name in ("discount", "critic_tau"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"`{name}` must be in [0, 1], got {getattr(self, name)}.")
        for name in ("learning_rate", "initial_temperature"):
            if not getattr(self, name) > 0:
                raise ValueError(f"`{name}` must be positive, got {getattr(self, name)}.")
        for name in ("shift_pad", "intrinsic_reward_coef", "video_episodes"):
            if getattr(self, name) < 0:
                raise ValueError(f"`{name}` must not be negative, got {getattr(self, name)}.")
        if self.replay_capacity is not None and self.replay_capacity < self.random_agent_steps:
            raise ValueError(
                f"`replay_capacity` ({self.replay_capacity}) must hold the {self.random_agent_steps} transitions "
                "of `random_agent_steps`, or no update would ever start."
            )
        if self.dense_precision not in ("auto", "bf16"):
            raise ValueError(f"`dense_precision` must be 'auto' or 'bf16', got {self.dense_precision!r}.")
        if self.dense_precision != "auto" and (self.features == "reencode" or self.algorithm == "drq"):
            raise ValueError(
                f"`dense_precision` is {self.dense_precision!r}, but neither features='reencode' nor drq keeps dense "
                "maps: leave it out."
            )
        if self.algorithm != "skill-ddpg" and self.skill_ddpg != SkillDDPGSettings():
            raise ValueError(
                f"`skill_ddpg` has settings, which {self.algorithm} does not read: leave them out, or choose the "
                "algorithm skill-ddpg."
            )
        if self.algorithm != "rad-sac" and self.intrinsic_reward_coef:
            raise ValueError(
                f"`intrinsic_reward_coef` is {self.intrinsic_reward_coef}, but {self.algorithm} has no bonus: set it "
                f"to 0, or start from {self.algorithm.replace('-', '_')}_settings(), which holds all its values."
            )

    @property
    def resolved_replay_capacity(self) -> int:
        """Transitions kept; ``train_downstream`` asks the artifact's method for it before it starts.

        Raises:
            ValueError: if nobody has asked yet.
        """
        if self.replay_capacity is None:
            raise ValueError(
                "`replay_capacity` is the method's, which is not known here; set it to a number."
            )
        return self.replay_capacity

    @property
    def resolved_action_repeat(self) -> int:
        """Simulator steps per decision; ``train_downstream`` asks the domain for it before it starts.

        Raises:
            ValueError: if nobody has asked the domain yet.
        """
        if self.action_repeat is None:
            raise ValueError("`action_repeat` is the domain's, which is not known here; set it to a number.")
        return self.action_repeat


@dataclass(frozen=True)
class DownstreamConfig(SACSettings):
    """Every setting of the downstream stage: the learner's, and where and how it runs."""

    seed: int = 0
    """seeds initialisation, environment, exploration, replay sampling, shifts, bonus and evaluation"""
    quality: Quality = "exact"
    """render quality"""
    colors: Colors = "normal"
    """colours of the task: reversed_background are the paper's unseen ones, reversed_image works everywhere"""
    precision: Literal["auto", "fp32", "bf16"] = "auto"
    """arithmetic of the big matrix products; `auto` is bf16 where the hardware is faster in it. Deviation: the
    released code computes in fp32 throughout, which `fp32` gives"""
    channels_last: Switch = "auto"
    """memory layout of the encoder's convolutions, which changes rounding only; `auto` is on"""
    compile: Switch = "auto"
    """compile the learner's losses with torch.compile, which changes rounding only; `auto` is off"""
    cuda_graph: Switch = "auto"
    """on a GPU, record the learner's updates and replay them, the action noise drawn there; `auto` is off"""
    eval_workers: int | None = None
    """processes that evaluate on the CPU while training goes on, 0.5 GB of memory each, at most one per episode; 0
    evaluates in between, in the training process. Left to itself a run takes one per core, and no more than torch has
    threads, if it has 20 evaluation episodes or more and another process can build its environment"""
    render_ahead: bool | None = None
    """draw the next observation in another thread while the update computes. Left to itself a run does so on a CPU with
    several cores; say no where an environment wants the main thread"""
    device: str = "cpu"
    """where networks and features live"""

    def __post_init__(self) -> None:
        """Refuse values that cannot run.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        super().__post_init__()
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"`seed` must be from 0 to {2**32 - 1}, got {self.seed}.")
        if self.eval_workers is not None and self.eval_workers < 0:
            raise ValueError(f"`eval_workers` must not be negative, got {self.eval_workers}.")
        for name in ("channels_last", "compile", "cuda_graph"):
            check_switch(name, getattr(self, name))
        for name in ("compile", "cuda_graph"):
            if self.algorithm == "skill-ddpg" and getattr(self, name) == "on":
                raise ValueError(f"`{name}` is 'on', which skill-ddpg does not have; leave it out.")


def drq_settings(**overrides: Any) -> DownstreamConfig:
    """Return DrQ's settings: end to end from pixels, without pre-training and without bonus.

    Source: denisyarats/drq (config, and batch 512 of its README); twice the budget of the pre-trained methods, as in
    CRPTpro's comparison.

    Args:
        **overrides: single settings of :class:`DownstreamConfig`.

    Examples:
        >>> drq_settings(seed=1).env_steps
        1000000
    """
    settings: dict[str, Any] = {
        "algorithm": "drq",
        "env_steps": 1_000_000,
        "replay_capacity": 100_000,
        "learning_rate": 1e-3,
        "intrinsic_reward_coef": 0.0,
    }
    return DownstreamConfig(**{**settings, **overrides})


def skill_ddpg_settings(**overrides: Any) -> DownstreamConfig:
    """Return the settings of BeCL's own downstream agent: skill-conditioned DDPG on a frozen encoder.

    Source: rll-research/url_benchmark and Rooshy-yang/BeCL. Deviation: batch and replay are those of the other
    pre-trained methods (512 and 40,000; natively 256 to 1,024 and 1,000,000), so that what is compared is the agent.
    Actor and critic start afresh, where the source copies the exploring actor and the critic's trunk.

    Args:
        **overrides: single settings of :class:`DownstreamConfig`.

    Examples:
        >>> skill_ddpg_settings(skill_ddpg=SkillDDPGSettings(skill=3)).skill_ddpg.n_step
        3
    """
    settings: dict[str, Any] = {
        "algorithm": "skill-ddpg",
        "random_agent_steps": 2_000,
        "intrinsic_reward_coef": 0.0,
    }
    return DownstreamConfig(**{**settings, **overrides})

"""The table of methods: the loss of each, how it is trained, how it explores, and its downstream settings.

A new method takes two files: its loss, and a row here (or a call of :func:`register_method`).
"""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from torch import nn
from torchrl.objectives import LossModule

from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.modules import PixelEncoder
from crptpro.objectives.contrastive import ATCLoss, BeCLLoss, SimCLRLoss
from crptpro.objectives.proto import ProtoLoss
from crptpro.values import check_numbers

RewardName = Literal["prototype", "particle", "skill-contrast"]
AgentName = Literal["rad-sac", "averaged-sac", "skill-ddpg"]

#: Downstream settings of CRPTpro that another method may replace.
DOWNSTREAM = {"env_steps": 500_000, "replay_capacity": 40_000, "learning_rate": 1e-4, "intrinsic_reward_coef": 0.2}


@dataclass(frozen=True)
class Exploration:
    """How a method explores while it pre-trains; the defaults are Proto-RL's.

    Every interval counts the agent steps of one domain. A number out of its range, an unknown name, or skills that do
    not fit agent and reward raise a ``ValueError``.
    """

    #: The agent's only reward: ``"prototype"``, ``"particle"``, ``"skill-contrast"``, or a function of the loss and a
    #: ``torch.Generator`` that returns a transform writing ``("next", "intrinsic_reward")``.
    reward: RewardName | Callable[..., Any] = "prototype"
    agent: AgentName = "rad-sac"  #: or ``"averaged-sac"`` (DrQ's K = M = 2 on detached features), or ``"skill-ddpg"``
    env_steps: int = 200_000  #: over all domains, random phases included
    is_single_domain: bool = False  #: the (S) variants: pre-trained on one domain only
    encoder_update_interval: int = 2  #: agent steps between two encoder updates
    encoder_updates_each: int = 1  #: encoder updates after each interval, each on a fresh batch
    agent_update_interval: int = 1  #: agent steps between two updates of the agent
    encodes_before_update: bool = False  #: reward and agent see features from before the encoder update of the step
    transfers_actor: bool = False  #: the downstream agent starts from the exploring actor
    n_step: int = 1  #: agent steps from an observation to the "next" one in batches of the agent and the encoder
    skill_dim: int | None = None  #: number of skills of skill-ddpg, at least two; None for the other agents
    skill_agent_steps: int = 50  #: agent steps between two changes of the skill
    replay_capacity: int = 100_000  #: transitions kept per domain
    random_agent_steps: int = 1_000  #: agent steps of uniformly random actions per domain, before its updates start

    def __post_init__(self) -> None:
        check_numbers(self, minima={"random_agent_steps": 0, "skill_dim": 2}, maxima={})
        for name, kind in (("agent", AgentName), ("reward", RewardName)):
            if (value := getattr(self, name)) not in get_args(kind) and not (name == "reward" and callable(value)):
                raise ValueError(f"`{name}` must be one of {', '.join(get_args(kind))}, got {value!r}.")
        has_skills = self.agent == "skill-ddpg"
        if has_skills != (self.skill_dim is not None) or (self.reward == "skill-contrast" and not has_skills):
            raise ValueError("The agent skill-ddpg, and no other, needs `skill_dim`; reward skill-contrast needs both.")


@dataclass(frozen=True)
class Method:
    """A row of the table; the defaults are CRPTpro's. Numbers out of range and unknown names raise a ``ValueError``."""

    name: str
    loss_class: type[LossModule] | None  #: built as ``loss_class(encoder, **loss_options)``; None without pre-training
    loss_options: Mapping[str, Any] = field(default_factory=dict)  #: keyword arguments of ``loss_class``
    #: Built as ``encoder_class(in_channels, image_size=..., **encoder_options)``.
    encoder_class: type[nn.Module] = PixelEncoder
    encoder_options: Mapping[str, Any] = field(default_factory=dict)  #: keyword arguments of ``encoder_class``
    updates: int = 50_000  #: encoder updates in total, over all domains
    batch_size: int = 512  #: transitions per update
    learning_rate: float = 1e-4  #: of Adam; the peak of a schedule
    encoder_tau: float | None = 0.05  #: rate of the target networks, every update; None for a method without targets
    schedule: Literal["constant", "warmup_cosine"] = "constant"  #: of the learning rate over the updates
    warmup_updates: int = 0  #: length of the linear warm-up of the learning rate from 0
    grad_clip: float | None = None  #: largest gradient norm; None for no clipping
    exploration: Exploration | None = None  #: None for a method that does not explore
    downstream: Mapping[str, Any] = field(default_factory=dict)  #: values that replace those of :data:`DOWNSTREAM`
    starts_from: str | None = None  #: method whose encoder it takes, to train it further for ``updates``
    is_preset: bool = False  #: a variant: not in :func:`method_names`, nor the default of its loss class
    is_builtin: bool = False  #: part of the library

    def __post_init__(self) -> None:
        check_numbers(self, minima={"updates": 0, "warmup_updates": 0}, maxima={"encoder_tau": 1})
        if self.loss_class is None and self.encoder_class is not PixelEncoder:
            raise ValueError(
                "Without a loss there is nothing to train an encoder of your own; see Pretrained(encoder)."
            )
        if self.schedule not in ("constant", "warmup_cosine"):
            raise ValueError(f"`schedule` must be 'constant' or 'warmup_cosine', got {self.schedule!r}.")
        if unknown := sorted(self.downstream.keys() - DOWNSTREAM.keys()):
            raise ValueError(f"A method has the downstream settings {', '.join(DOWNSTREAM)}, not {', '.join(unknown)}.")

    def build_encoder(self, in_channels: int = 9, image_size: int = 84, **options: Any) -> Any:
        """Build the encoder that the method trains; ``options`` override the method's own."""
        options = {"image_size": image_size, **self.encoder_options, **options}
        _require_known("An encoder", options, self.encoder_class)
        return self.encoder_class(in_channels, **options)

    def build(self, encoder: nn.Module, **options: Any) -> LossModule:
        """Build the loss on ``encoder``; ``options`` override the method's own; unknown ones raise a ``ValueError``."""
        if self.loss_class is None:
            raise CRPTproError(f"The method {self.name!r} pre-trains nothing; it is for downstream training.")
        _require_known(f"The method {self.name!r}", options, self.loss_class)
        loss = self.loss_class(encoder, **{**self.loss_options, **options})
        loss.method_name = self.name  # for method_of
        return loss


def _require_known(owner: str, options: Mapping[str, Any], made: type) -> None:
    parameters = inspect.signature(made.__init__).parameters  # type: ignore[misc]
    unknown = sorted(set(options) - set(parameters))
    if unknown and not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        known = ", ".join(list(parameters)[2:])  # without self and the first argument
        raise ValueError(f"{owner} has no option {', '.join(unknown)}; it has {known}.")


_NO_BONUS = {"intrinsic_reward_coef": 0.0}
_DRQ = {"env_steps": 1_000_000, "replay_capacity": 100_000, "learning_rate": 1e-3}
_CRPTPRO = Method("crptpro", ProtoLoss)

# ATC's loss, head and schedule on the encoder (orthogonal weights), batch and budget that all methods share.
_ATC = Method(
    "atc", ATCLoss, learning_rate=1e-3, encoder_tau=0.01, schedule="warmup_cosine", warmup_updates=1_000,
    grad_clip=10.0, downstream=_NO_BONUS,
)  # fmt: skip

# Active methods: four env steps per encoder update, 200,000 in total over a group (C) or 500,000 in one domain (S).
# The paper's efficiency table has equal times for one to three domains, so (C) counts in total.
_SINGLE_DOMAIN: dict[str, Any] = {"env_steps": 500_000, "is_single_domain": True}
_PROTO_RL_S_EXPLORES = Exploration(transfers_actor=True, **_SINGLE_DOMAIN)
_APT_EXPLORES = Exploration(reward="particle", agent="averaged-sac")
_APT_C = Method("apt-c", SimCLRLoss, encoder_tau=None, exploration=_APT_EXPLORES, downstream=_NO_BONUS)
# Deviation: Proto-RL's released code has a predictor of width 512; the paper's table lists 1024, also used here.
_PROTO_RL_C = Method(
    "proto-rl-c", ProtoLoss, loss_options={"intr_loss_coef": 0.0}, exploration=Exploration(),
    downstream={"replay_capacity": 100_000},
)  # fmt: skip

# Three encoder updates for each update of the agent, every second agent step.
_BECL_EXPLORES = Exploration(
    reward="skill-contrast", agent="skill-ddpg", encoder_updates_each=3, encodes_before_update=True,
    agent_update_interval=2, n_step=3, skill_dim=16, random_agent_steps=2_000,
)  # fmt: skip
_BECL = Method(
    "becl", BeCLLoss, updates=150_000, encoder_tau=None, encoder_options={"pixel_offset": 0.5},
    exploration=_BECL_EXPLORES, downstream=_NO_BONUS,
)  # fmt: skip


_preset = functools.partial(replace, is_preset=True)

# A loss built by hand is trained by the first row of its class that is not a preset and does not explore.
TABLE = (
    _CRPTPRO,
    _preset(_CRPTPRO, name="crptpro-no-bonus", updates=0, starts_from="crptpro", downstream=_NO_BONUS),
    # Deviation: targets at half the student's temperature leave the plateau at ln M sooner; three times the learning
    # rate gets further after it (docs/study.md).
    _preset(_CRPTPRO, name="crptpro-fast", learning_rate=3e-4, loss_options={"assignment_temperature": 0.05}),
    _preset(_CRPTPRO, name="crptpro-finetune", updates=2_000, starts_from="crptpro"),
    # The authors' published code where it differs from the paper: predictor width, and 3 x 16,666 updates.
    _preset(_CRPTPRO, name="released-code", updates=49_998, loss_options={"hidden_dim": 512}),
    _ATC,
    _preset(_ATC, name="atc-native", batch_size=256, encoder_options={"strides": (2, 2, 2, 1), "init": "kaiming"}),
    _APT_C,
    replace(_APT_C, name="apt-s", updates=125_000, exploration=replace(_APT_EXPLORES, **_SINGLE_DOMAIN)),
    _PROTO_RL_C,
    replace(_PROTO_RL_C, name="proto-rl-s", updates=125_000, exploration=_PROTO_RL_S_EXPLORES),
    _BECL,
    # Trains the encoder end to end, with the critic.
    Method("drq", None, updates=0, downstream=_DRQ | _NO_BONUS),
    # Controls: the encoder at initialisation, and with features of mean 0 and deviation 1.
    Method("random-encoder", None, updates=0, downstream=_NO_BONUS),
    Method("random-encoder-standardised", None, updates=0, downstream=_NO_BONUS),
)

_METHODS: dict[str, Method] = {row.name: replace(row, is_builtin=True) for row in TABLE}


def register_method(name: str, loss_class: type[LossModule], **fields: Any) -> Method:
    """Make a method available by name, on the command line too.

    ``fields`` are further fields of :class:`Method`, such as ``updates=10_000`` or ``exploration=Exploration()``, but
    not ``starts_from``. The last registration of a name counts. A name of the library's own methods, or a number out of
    its range, raises a ``ValueError``.
    """
    if "starts_from" in fields:
        raise ValueError(f"The method {name!r} must pre-train its own encoder: `starts_from` is for built-in methods.")
    if name in _METHODS and _METHODS[name].is_builtin:
        raise ValueError(f"{name!r} is a method of the library; choose another name.")
    _METHODS[name] = Method(name, loss_class, **fields)
    return _METHODS[name]


def get_method(name: str) -> Method:
    """Return the method or preset of a name; an ``UnknownNameError`` suggests the nearest names."""
    if name not in _METHODS:
        known = sorted(_METHODS)
        nearest = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
        raise UnknownNameError(f"There is no method {name!r}. Did you mean {', '.join(nearest or known)}?")
    return _METHODS[name]


def method_names(*, presets: bool = False) -> list[str]:
    """Return the names of the methods that pre-train an encoder, sorted; with ``presets``, of every row."""
    return sorted(name for name, row in _METHODS.items() if presets or not (row.is_preset or row.loss_class is None))


def method_of(loss: LossModule) -> Method:
    """Return the method that built a loss, or for a loss built by hand the first passive one of its class.

    If its class has none, the method is named after the class; its numbers are those of the nearest base class that has
    one, or CRPTpro's, and its ``encoder_tau`` is None exactly if the loss has no targets.
    """
    if (named := _METHODS.get(getattr(loss, "method_name", None) or "")) is not None:
        return named
    loss_class = type(loss)
    # It is not known whether a loss built by hand will explore.
    listed = [row for row in _METHODS.values() if not row.is_preset and row.exploration is None]
    found = next((row for base in loss_class.__mro__ for row in listed if row.loss_class is base), None)
    if found is not None and found.loss_class is loss_class:
        return found
    method = replace(found or _CRPTPRO, name=loss_class.__name__, loss_class=loss_class, is_builtin=False)
    if not any(name.startswith("target_") for name, _ in loss.named_children()):
        return replace(method, encoder_tau=None)
    return method if method.encoder_tau is not None else replace(method, encoder_tau=_CRPTPRO.encoder_tau)

"""Active pre-training: an agent explores each domain while one encoder learns from all of them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import step_mdp
from torchrl.objectives import LossModule

from crptpro.artifact import require_disk
from crptpro.data import FrameReplay
from crptpro.domains import Domain, get_domain
from crptpro.envs import make_env, resolve_action_repeat
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.logging import RunLogger
from crptpro.modules import (
    DeterministicActor,
    SquashedGaussianActor,
    TwinCritic,
    computing,
    resolve_precision,
    set_compute_dtype,
    usable_device,
)
from crptpro.modules.precision import Precision
from crptpro.objectives import (
    AveragedSACLoss,
    Method,
    RADSACLoss,
    SkillDDPGLoss,
    get_method,
    method_names,
    method_of,
)
from crptpro.seeding import derive_seed
from crptpro.training.agent import EnvThread, SACLearner, SkillDDPGLearner, uniform_action
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.downstream import runs_ahead
from crptpro.training.pretrain import (
    SHIFT_PAD,
    PretrainResult,
    describe_loss,
    make_optimizer,
    normalise_prototypes,
    scalars,
    total_loss,
    training_card,
    write_row,
)
from crptpro.training.run import Generators, Run
from crptpro.transforms import ContrastiveReward, FrozenEncoder, ParticleReward, PrototypeReward, RandomShift
from crptpro.transforms.rewards import warn_if_mostly_zero
from crptpro.values import Quality, check_numbers

logger = logging.getLogger(__name__)

PIXELS: tuple[NestedKey, ...] = ("pixels", ("next", "pixels"))
SECOND_VIEWS: dict[NestedKey, NestedKey] = {
    "pixels_view": "pixels",
    ("next", "pixels_view"): ("next", "pixels"),
}
AGENT_LEARNING_RATE, DISCOUNT = 1e-4, 0.99
_PLAIN_NAME = re.compile(r"\w[\w.:+-]*")


@dataclass(frozen=True)
class ExploreConfig:
    """How agents explore while an encoder is pre-trained. ``None`` means the method's own value.

    Source: Proto-RL's released agent (denisyarats/proto) and CRPTpro's comparison of it across domains. Every interval
    counts a domain's own decisions, so that no domain is left out whatever their number.
    """

    env_steps: int | None = None
    """budget in simulator steps, shared by all domains (default: the method's; -c 200,000, -s 500,000)"""
    batch_size: int | None = None
    """transitions per update, of encoder and agent alike (default: the method's)"""
    learning_rate: float | None = None
    """of the encoder's Adam (default: the method's)"""
    encoder_update_interval: int | None = None
    """decisions in a domain between two encoder updates on it (default: the method's, 2)"""
    random_agent_steps: int | None = None
    """decisions per domain taken uniformly at random before its first update (default: the method's)"""
    replay_capacity: int | None = None
    """transitions kept per domain (default: the method's, 100,000)"""
    hidden_dim: int = 1_024
    """width of the two hidden layers of the agents' actors and critics"""
    queue_size: int = 2_048
    """candidates that the prototype reward keeps, a multiple of the number of prototypes"""
    seed: int = 0
    """seeds agents, environments, exploration, sampling and shifts"""
    quality: Quality = "exact"
    """render quality"""
    precision: Precision = "auto"
    """arithmetic of convolutions and big matrix products; auto is bf16 where the hardware is faster in it. Deviation:
    the released code computes in fp32 throughout, which fp32 gives"""
    device: str = "cpu"
    """where networks are"""
    log_interval: int = 50
    """encoder updates between two rows of the record"""
    checkpoint_interval_env_steps: int = 5_000
    """simulator steps, over all domains, between two checkpoints"""

    def __post_init__(self) -> None:
        """Convert numbers to plain values.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        counts = {
            "env_steps": 1, "batch_size": 1, "encoder_update_interval": 1, "random_agent_steps": 0,
            "replay_capacity": 1, "hidden_dim": 1, "queue_size": 1, "log_interval": 1,
            "checkpoint_interval_env_steps": 1,
        }  # fmt: skip
        check_numbers(self, counts=counts, rates={"learning_rate": None})

    def resolved(self, method: Method) -> Any:
        """Return the settings with the method's values where they were left open."""
        values = {
            name: getattr(method, name)
            for name in ("batch_size", "learning_rate")
            if getattr(self, name) is None
        }
        for name in ("env_steps", "encoder_update_interval", "random_agent_steps", "replay_capacity"):
            if getattr(self, name) is None:
                values[name] = getattr(method.exploration, name)
        return dataclasses.replace(self, **values)


@dataclass(frozen=True)
class ExplorationPlan:
    """How many decisions and updates an active pre-training makes, and when; domains take turns, one decision each.

    Attributes:
        repeats: simulator steps per decision, of each domain.
        agent_steps: decisions of each domain.
        first_update: decision of a domain from which on updates come with it.
        encoder_update_interval: of a domain's own decisions.
        encoder_updates_each: encoder updates every time.
        agent_update_interval: of a domain's own decisions.
    """

    repeats: tuple[int, ...]
    agent_steps: int
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
        return self.agent_steps * sum(self.repeats)

    @property
    def encoder_updates(self) -> int:
        """Over all domains."""
        interval = self.encoder_update_interval
        times = max(0, -(-self.agent_steps // interval) - -(-self.first_update // interval))
        return times * self.encoder_updates_each * len(self.repeats)

    def trains_encoder(self, agent_step: int) -> bool:
        """Whether a domain's decision ``agent_step`` (from 0) comes with encoder updates."""
        return agent_step >= self.first_update and agent_step % self.encoder_update_interval == 0

    def trains_agent(self, agent_step: int) -> bool:
        """Whether a domain's decision ``agent_step`` (from 0) comes with an update of its agent."""
        return agent_step >= self.first_update and agent_step % self.agent_update_interval == 0


def plan_exploration(
    method: Method, domains: Sequence[str | Domain], config: ExploreConfig | None = None
) -> ExplorationPlan:
    """Spread a method's budget over domains.

    Raises:
        CRPTproError: the method does not explore, or the budget ends before the first update.
    """
    if method.exploration is None:
        raise CRPTproError(
            f"The method {method.name} learns from datasets and does not explore; use pretrain()."
        )
    settings = (config or ExploreConfig()).resolved(method)
    repeats = tuple(_action_repeat(domain) for domain in domains)
    plan = ExplorationPlan(
        repeats=repeats,
        agent_steps=-(-settings.env_steps // sum(repeats)),
        first_update=max(settings.random_agent_steps, method.exploration.n_step),
        encoder_update_interval=settings.encoder_update_interval,
        encoder_updates_each=method.exploration.encoder_updates_each,
        agent_update_interval=method.exploration.agent_update_interval,
    )
    if not plan.encoder_updates:
        raise CRPTproError(
            f"{settings.env_steps:,} env steps are {plan.agent_steps:,} decisions per domain, of which the first "
            f"{plan.first_update:,} come without updates: nothing would be learned. Ask for more env_steps or fewer "
            "random_agent_steps."
        )
    return plan


@dataclass(frozen=True)
class ExploreResult(PretrainResult):
    """How an active pre-training ended.

    Attributes:
        env_steps: simulator steps over all domains.
        actor: the exploring actor, for a method that hands it to downstream runs.
        queue: candidates of the prototype reward, float32 ``[queue_size, D]``, the oldest first.
    """

    env_steps: int = 0
    actor: nn.Module | None = field(default=None, repr=False)
    queue: Tensor | None = field(default=None, repr=False)


def pretrain_active(
    loss: LossModule,
    domains: str | Domain | Sequence[str | Domain],
    *,
    method: str | None = None,
    run_dir: str | Path | None = None,
    config: ExploreConfig | None = None,
    records: RunLogger | None = None,
    resume: bool = True,
    progress: bool = True,
    env_factory: Callable[..., EnvBase] = make_env,
    **overrides: Any,
) -> ExploreResult:
    """Train a self-supervised loss on what exploring agents see (Proto-RL, APT, BeCL; here also across domains).

    The domains take turns, one decision each. A domain has its own environment, replay, actor, critic and temperature;
    encoder, heads, prototypes and their optimiser are shared. Its agent learns from the intrinsic reward alone, on
    detached features; the encoder learns from the self-supervised loss alone, on batches of one domain at a time.

    Deviation: neither the paper nor the released code says how its cross-domain active baselines are built. Turns,
    shared candidates and schedules in a domain's own decisions are this project's choice.

    With ``run_dir`` the run can be killed at any moment: the same call with a newly built loss continues from the last
    checkpoint and, on a CPU, gives the same numbers as an uninterrupted one.

    Args:
        loss: the objective with its networks; trained in place.
        domains: one or several, by domain or task name.
        method: name of a registered method that explores; by default the first one of the loss's class that does.
        run_dir: records (``pretrain.csv``, ``explore.csv``, ``episodes.csv``), replays and checkpoints; ``None`` keeps
            nothing but the result.
        config: every number.
        records: used instead of a record in ``run_dir``.
        resume: continue what ``run_dir`` holds; ``False`` refuses a directory that holds a run.
        progress: show a bar, or lines in a log file.
        env_factory: makes the environments; called as :func:`~crptpro.envs.make_env` is, in threads of their own.
        **overrides: single settings of :class:`ExploreConfig`, e.g. ``env_steps=50_000``.

    Raises:
        CRPTproError: a single-domain method was given several domains, the loss does not suffice for the reward, or
            the budget is too small for any update.
        CheckpointError: ``run_dir`` holds a run of other settings (named).
        NonFiniteError: a loss, a weight or an action is not finite; the last checkpoint is kept.
        DiskSpaceError: the disk cannot hold the replays.
    """
    recipe = _exploring_method(loss) if method is None else get_method(method)
    asked = dataclasses.replace(config or ExploreConfig(), **overrides)
    named = name_domains(domains, recipe)
    plan = plan_exploration(recipe, list(named.values()), asked)
    exploration: Any = recipe.exploration
    settings = asked.resolved(recipe)
    prototypes = getattr(loss, "prototypes", None)
    count = len(prototypes.weight) if exploration.reward == "prototype" and prototypes is not None else 1
    if settings.queue_size % count:
        raise ValueError(
            f"queue_size must be a multiple of num_prototypes, got {settings.queue_size} and {count}."
        )
    device = usable_device(settings.device)
    loss.to(device).train()
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(Run(run_dir, unit="env_steps", streams=("pretrain", "explore", "episodes"),
                                      records=records, config=settings, resume=resume, progress=progress))  # fmt: skip
        dtype = resolve_precision(run.saved_setting("precision", settings.precision), device)
        stack.enter_context(computing(loss, dtype))
        run.require_same({
            "domains": list(named), "precision": "bf16" if dtype == torch.bfloat16 else "fp32",
            "loss": describe_loss(loss), "exploration": {
                **dataclasses.asdict(exploration),
                "reward": getattr(exploration.reward, "__qualname__", exploration.reward),
            },
            **{k: v for k, v in dataclasses.asdict(settings).items() if k not in ("precision", "device")},
        })  # fmt: skip
        torch.manual_seed(derive_seed(settings.seed, "active", "loss"))
        logger.info(
            "active pre-training: %s env steps over %s (%s decisions in each, the first %s random), %s encoder updates "
            "of batch %d", f"{plan.env_steps:,}", ", ".join(named), f"{plan.agent_steps:,}",
            f"{settings.random_agent_steps:,}", f"{plan.encoder_updates:,}", settings.batch_size,
        )  # fmt: skip
        capacity = min(settings.replay_capacity, plan.agent_steps)
        slack = 4 * (settings.checkpoint_interval_env_steps // sum(plan.repeats)) + 2_000
        _announce_replays(run, loss, len(named) * (capacity + slack))
        optimizer, schedule, targets = make_optimizer(
            loss, recipe, learning_rate=settings.learning_rate, warmup_updates=recipe.warmup_updates,
            encoder_tau=recipe.encoder_tau, updates=plan.encoder_updates,
        )  # fmt: skip
        monitor = CollapseMonitor.of(loss)
        explorers: list[Explorer] = []
        for name, domain in named.items():
            reward = explorers[0].reward if explorers and exploration.reward == "prototype" else None
            explorer = Explorer(name, domain, loss, recipe, settings, run, reward=reward, capacity=capacity,
                                slack=slack, dtype=dtype, env_factory=env_factory)  # fmt: skip
            stack.callback(explorer.close)
            explorers.append(explorer)
        done = run.tally
        done.update(decisions=0, updates=0)
        run.keep(loss=loss, optimizer=optimizer, schedule=schedule, targets=targets, monitor=monitor,
                 **{f"explorer_{e.name}": e for e in explorers})  # fmt: skip

        def update_encoder(batch: TensorDictBase) -> TensorDictBase:
            normalise_prototypes(loss)
            losses = loss(batch)
            optimizer.zero_grad(set_to_none=True)
            total_loss(losses).backward()
            optimizer.step()
            if targets is not None:
                targets.step()
            return losses.detach()

        for _ in run.until(plan.env_steps, checkpoint_interval=settings.checkpoint_interval_env_steps):
            index = done["decisions"] % len(explorers)
            explorer, agent_step = explorers[index], explorers[index].agent_steps
            explorer.begin_step()  # the next observation is drawn while the updates compute
            trains_encoder, trains_agent = plan.trains_encoder(agent_step), plan.trains_agent(agent_step)
            if trains_encoder or trains_agent:
                batch = explorer.sample(settings.batch_size)
            for again in range(plan.encoder_updates_each if trains_encoder else 0):
                batch = explorer.sample(settings.batch_size) if again else batch
                if again == plan.encoder_updates_each - 1 and exploration.encodes_before_update:
                    batch = explorer.encode(batch)
                losses = update_encoder(batch)
                schedule.step()
                done["updates"] += 1
                run.counters["updates"] = done["updates"]
                run.log(scalars(losses, explorer.name))
                if done["updates"] % settings.log_interval == 0:
                    write_row(run, loss, monitor, batch, explorer.name)
                    run.write("explore")
            if trains_agent:
                if not (trains_encoder and exploration.encodes_before_update):
                    batch = explorer.encode(batch)
                metrics = explorer.learn(batch, agent_step // plan.agent_update_interval)
                run.log(
                    {f"{name}/{explorer.name}": value for name, value in metrics.items()}, stream="explore"
                )
            if (row := explorer.end_step()) is not None:
                run.write("episodes", {"domain": explorer.name, **row}, episodes=explorer.episodes)
            done["decisions"] += 1
            run.advance(plan.repeats[index])
        run.finish()
        if run.means["pretrain"].counts:
            write_row(
                run, loss, monitor, explorers[0].sample(min(settings.batch_size, 64)), explorers[0].name
            )
            run.write("explore")
        updates = done["updates"]
        collapse, metrics = monitor.finish(updates), run.last_row("pretrain")
        facts = [{"domain": e.name, "agent_steps": e.agent_steps, "episodes": e.episodes} for e in explorers]
        run.counters["updates"] = updates
        training = training_card(
            run, monitor, metrics=metrics, device=str(device), datasets=facts, env_steps=run.position
        )
        return ExploreResult(
            loss, recipe.name, updates, run.resumed_from, metrics, collapse, training, run.history["pretrain"],
            env_steps=run.position, actor=explorers[0].actor if exploration.transfers_actor else None,
            queue=explorers[0].candidates(),
        )  # fmt: skip


class Explorer:
    """One domain of an active pre-training: its environment, its replay, its agent and its intrinsic reward.

    A checkpoint may fall into an episode. No simulator state is kept for it: the episode is repeated from its seed with
    the same actions.
    """

    def __init__(
        self,
        name: str,
        domain: str | Domain,
        loss: LossModule,
        method: Method,
        config: Any,
        run: Run,
        *,
        reward: Transform | None,
        capacity: int,
        slack: int,
        dtype: torch.dtype,
        env_factory: Callable[..., EnvBase],
    ) -> None:
        self.name, self.loss, self.config = name, loss, config
        self.exploration: Any = method.exploration
        self.seed = derive_seed(config.seed, "active", name)
        self.device = torch.device(config.device)
        encoder = loss.encoder
        make_this_env = functools.partial(
            env_factory,
            get_domain(domain) if env_factory is make_env else domain,
            seed=self.seed,
            quality=config.quality,
            action_repeat=_action_repeat(domain),
            image_size=getattr(encoder, "image_size", 84),
            frame_stack=getattr(encoder, "in_channels", 9) // 3,
        )
        self._env = EnvThread(make_this_env, runs_ahead=runs_ahead(name, config.device))
        self.generators = Generators(
            self.seed, "replay", "shift", "policy", "random_actions", "skill", "reward"
        )
        torch.manual_seed(
            derive_seed(self.seed, "agent")
        )  # a domain's networks do not depend on the other domains
        action_dim = self._env.env.action_spec.shape[-1]
        self.learner = self._make_learner(encoder.feature_dim, action_dim)
        set_compute_dtype(self.learner.loss, dtype)
        self.actor = self.learner.loss.actor
        self.reward = self._make_reward() if reward is None else reward
        self.replay = self._make_replay(run, capacity, slack)
        self.agent_steps = self.episodes = self.skill = 0
        self.actions: list[Tensor] = []
        self._td: TensorDictBase | None = None
        self._episode_return = 0.0

    def begin_step(self) -> None:
        """Choose an action, uniformly at random at first, and begin the environment's step."""
        if self._td is None:
            self._td = self._reset()
        if (
            self.exploration.skill_dim is not None
            and len(self.actions) % self.exploration.skill_agent_steps == 0
        ):
            self.skill = int(
                torch.randint(self.exploration.skill_dim, (), generator=self.generators["skill"])
            )
        self._td["action"] = self._act(self._td["pixels"])
        if self.exploration.skill_dim is not None:
            self._td["skill"] = self._one_hot_skill()
        self._step = self._env.step(self._td)

    def end_step(self) -> dict[str, float] | None:
        """Store the outcome of the step; returns the episode's return and length if it ended one."""
        transition = self._in_the_world(self._step.result)
        self.replay.extend(transition)
        self.actions.append(transition["action"].clone())
        self._episode_return += transition["next", "reward"].item()
        self.agent_steps += 1
        self._td = step_mdp(transition)
        if not transition["next", "done"].item():
            return None
        row = {"episode_return": self._episode_return, "episode_agent_steps": len(self.actions)}
        self._td, self.actions, self._episode_return, self.episodes = None, [], 0.0, self.episodes + 1
        return row

    def sample(self, batch_size: int) -> TensorDictBase:
        """Draw a batch of transitions, every image under a random shift of its own."""
        return self.replay.sample(batch_size).to(self.device)

    def encode(self, batch: TensorDictBase) -> TensorDictBase:
        """Add the features of every image to a batch, without gradient."""
        return self._features(batch)

    def learn(self, batch: TensorDictBase, agent_step: int) -> dict[str, Tensor]:
        """Let the agent learn from the intrinsic reward of a batch with features; returns detached scalars."""
        batch = self.reward(batch)
        intrinsic = batch["next", "intrinsic_reward"]
        batch["next", "reward"] = intrinsic
        if isinstance(self.learner, SkillDDPGLearner) and batch.get(("next", "discount"), None) is None:
            batch["next", "discount"] = DISCOUNT * (~batch["next", "terminated"]).to(intrinsic)
        losses = self.learner.update(batch, agent_step=agent_step)
        return {"intrinsic_reward": intrinsic.mean(), **dict(losses.items())}

    def candidates(self) -> Tensor | None:
        """Return the candidates of a prototype reward, the one that is overwritten next first."""
        if not isinstance(self.reward, PrototypeReward):
            return None
        return self.reward.queue.roll(-int(self.reward.queue_pointer), 0).clone()

    def close(self) -> None:
        """Free the render context."""
        self._env.close()

    # --- checkpoints --------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return where the domain stands."""
        return {
            "counters": [self.agent_steps, self.episodes, self.skill],
            "actions": torch.stack(self.actions) if self.actions else None,
            "learner": {name: part.state_dict() for name, part in self.learner.components().items()},
            "reward": self._reward_state(),
            "replay": self.replay.state_dict(),
            "generators": self.generators.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`; the episode that was under way is repeated."""
        self.agent_steps, self.episodes, self.skill = state["counters"]
        for name, part in self.learner.components().items():
            part.load_state_dict(state["learner"][name])
        self.reward.load_state_dict(state["reward"], strict=False)
        self.replay.load_state_dict(state["replay"])
        self.generators.load_state_dict(state["generators"])
        if state["actions"] is None:
            return
        td = self._reset()
        for action in state["actions"]:
            td["action"] = action
            transition = self._in_the_world(self._env.step(td).result)
            self._episode_return += transition["next", "reward"].item()
            self.actions.append(action)
            td = step_mdp(transition)
        self._td = td
        newest = self.replay.observations(torch.tensor([self.replay.frames_written - 1]))[0]
        if not torch.equal(newest, td["pixels"]):
            logger.warning(
                "%s does not repeat an episode from its seed and actions; this run will differ from an "
                "uninterrupted one.",
                self.name,
            )

    def _reward_state(self) -> dict[str, Tensor]:
        """Return what the reward remembers; the networks that it reads belong to the loss."""
        networks = {id(tensor) for tensor in (*self.loss.parameters(), *self.loss.buffers())}
        return {
            k: v.detach() for k, v in self.reward.state_dict(keep_vars=True).items() if id(v) not in networks
        }

    # --- parts --------------------------------------------------------------------------------------------------

    def _make_learner(self, feature_dim: int, action_dim: int) -> SACLearner | SkillDDPGLearner:
        hidden, generator = self.config.hidden_dim, self.generators["policy"]
        if self.exploration.agent == "skill-ddpg":
            skills = self.exploration.skill_dim
            skilled = DeterministicActor(feature_dim, action_dim, skill_dim=skills, hidden_dim=hidden)
            skilled.to(self.device)
            critic = TwinCritic(feature_dim + skills, action_dim, hidden_dim=hidden, has_tanh=True).to(
                self.device
            )
            return SkillDDPGLearner(
                SkillDDPGLoss(skilled, critic, generator=generator), learning_rate=AGENT_LEARNING_RATE
            )
        loss_class = {"rad-sac": RADSACLoss, "averaged-sac": AveragedSACLoss}[self.exploration.agent]
        actor = SquashedGaussianActor(feature_dim, action_dim, hidden_dim=hidden).to(self.device)
        critic = TwinCritic(feature_dim, action_dim, hidden_dim=hidden).to(self.device)
        loss = loss_class(actor, critic, gamma=DISCOUNT, alpha_init=0.1, generator=generator)
        return SACLearner(loss, learning_rate=AGENT_LEARNING_RATE)

    def _make_reward(self) -> Transform:
        loss, generator, kind = self.loss, self.generators["reward"], self.exploration.reward
        needs = {
            "prototype": ("projector", "prototypes"),
            "particle": ("projector",),
            "skill-contrast": ("projector",),
        }
        missing = [name for name in needs.get(str(kind), ()) if getattr(loss, name, None) is None]
        if missing:
            raise CRPTproError(
                f"The {kind} reward needs a loss with {' and '.join(needs[str(kind)])}; {type(loss).__name__} has no "
                f"{' and no '.join(missing)}."
            )
        if kind == "prototype":
            warn_if_mostly_zero(len(loss.prototypes.weight), self.config.batch_size, 3)
            reward: Transform = PrototypeReward(loss.projector, loss.prototypes, coef=None, generator=generator,
                                                queue_size=self.config.queue_size)  # fmt: skip
        elif kind == "particle":
            reward = ParticleReward(loss.projector)
        elif kind == "skill-contrast":
            reward = ContrastiveReward(loss.projector, temperature=float(loss.temperature))
        else:
            reward = kind(loss, generator)  # a method of one's own brings a function that builds its reward
        return reward.to(self.device)

    def _make_replay(self, run: Run, capacity: int, slack: int) -> FrameReplay:
        channels, height, width = self._env.env.observation_spec["pixels"].shape
        path = None if run.run_dir is None else run.run_dir / "replay" / self.name
        if path is not None and not run.saved:
            shutil.rmtree(path, ignore_errors=True)  # of an attempt without a checkpoint
        skills = self.exploration.skill_dim
        replay = FrameReplay(
            capacity, frame_shape=(3, height, width), action_dim=self._env.env.action_spec.shape[-1],
            frame_stack=channels // 3, path=path, slack=slack, n_step=self.exploration.n_step, discount=DISCOUNT,
            extra_columns=None if skills is None else {"skill": ((skills,), torch.float32)},
            generator=self.generators["replay"],
        )  # fmt: skip
        agent_views = SECOND_VIEWS if isinstance(self.learner.loss, AveragedSACLoss) else {}
        views = {**getattr(self.loss, "views", {}), **agent_views}
        images = [*PIXELS, *agent_views]
        replay.append_transform(
            RandomShift(pad=SHIFT_PAD, in_keys=[*views.values(), *PIXELS], out_keys=[*views, *PIXELS],
                        generator=self.generators["shift"])
        )  # fmt: skip
        self._features = FrozenEncoder(
            self.loss.encoder, in_keys=images, out_keys=[features_key(key) for key in images]
        )
        return replay

    @torch.no_grad()
    def _act(self, pixels: Tensor) -> Tensor:
        if self.agent_steps < self.config.random_agent_steps:
            return uniform_action(self._env.env, self.generators["random_actions"])
        features, generator = (
            self.loss.encoder(pixels.unsqueeze(0).to(self.device)),
            self.generators["policy"],
        )
        if self.exploration.skill_dim is not None:
            skill = self._one_hot_skill().unsqueeze(0).to(self.device)
            action = self.actor.sample(torch.cat([features, skill], -1), generator=generator)
        else:
            action = self.actor.sample(features, generator=generator)[0]
        action = action.squeeze(0).float().cpu().clamp(-1, 1)
        if not torch.isfinite(action).all():
            raise CRPTproError(
                f"After {self.agent_steps:,} decisions the explorer of {self.name} acts {action.tolist()}: it has "
                "diverged. The last checkpoint is kept."
            )
        return action

    def _one_hot_skill(self) -> Tensor:
        return nn.functional.one_hot(torch.tensor(self.skill), self.exploration.skill_dim).float()

    def _reset(self) -> TensorDictBase:
        seed = derive_seed(self.seed, "active", self.name, "episode", self.episodes)
        return self._in_the_world(lambda: self._env.reset(seed))

    def _in_the_world(self, work: Callable[[], TensorDictBase]) -> TensorDictBase:
        """Do something in the environment; its errors do not say which of several it was."""
        try:
            return work()
        except CRPTproError:
            raise
        except Exception as reason:
            raise CRPTproError(
                f"The world of {self.name} failed in episode {self.episodes}, decision {len(self.actions)}: {reason!r}."
            ) from reason


def features_key(pixels_key: NestedKey) -> NestedKey:
    """Return the key of an image entry's features.

    Examples:
        >>> features_key(("next", "pixels_view"))
        ('next', 'features_view')
    """
    *lead, last = (pixels_key,) if isinstance(pixels_key, str) else pixels_key
    return unravel_key((*lead, str(last).replace("pixels", "features")))


def name_domains(domains: str | Domain | Sequence[str | Domain], method: Method) -> dict[str, str | Domain]:
    """Return the domains of a run by name.

    Raises:
        CRPTproError: none, one twice, or several for a method that explores one.
    """
    listed = [domains] if isinstance(domains, (str, Domain)) else list(domains)
    named: dict[str, str | Domain] = {}
    for domain in listed:
        try:
            name = get_domain(domain).name
        except UnknownNameError:  # a caller's own factory may know it
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
    if method.exploration is not None and method.exploration.is_single_domain and len(named) > 1:
        raise CRPTproError(
            f"{method.name} pre-trains on one domain, got {len(named)} ({', '.join(named)}). Run it once per domain, "
            "or use the method's cross-domain variant (-c)."
        )
    return named


def _exploring_method(loss: LossModule) -> Method:
    """Return the method of a loss, or else the first one of its class that explores."""
    found = method_of(loss)
    if found.exploration is not None:
        return found
    rows = [get_method(name) for name in method_names()]
    return next((row for row in rows if row.loss_class is type(loss) and row.exploration is not None), found)


def _action_repeat(domain: str | Domain) -> int:
    try:
        return resolve_action_repeat(domain, None)
    except UnknownNameError:
        return 2


def _announce_replays(run: Run, loss: LossModule, frames: int) -> None:
    if run.run_dir is None or run.saved:
        return
    size = getattr(loss.encoder, "image_size", 84)
    needed = frames * 3 * size * size
    logger.info("replays: %.2f GB in %s; they stay there", needed / 1e9, run.run_dir / "replay")
    require_disk(run.run_dir, needed, "The replays of the domains")

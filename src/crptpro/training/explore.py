"""Active pre-training: an agent explores each domain while one encoder learns from all of them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import step_mdp
from torchrl.objectives import LossModule

from crptpro.artifact import require_disk
from crptpro.data import FrameReplay
from crptpro.data.collect import dataset_path
from crptpro.domains import Domain, describe_domain, get_domain
from crptpro.envs import resolve_action_repeat
from crptpro.errors import CRPTproError
from crptpro.logging import RunLogger
from crptpro.modules import DeterministicActor, SquashedGaussianActor, TwinCritic, computing
from crptpro.modules.encoder import images_of
from crptpro.modules.precision import PRECISION_NAMES, Precision, set_compute_dtype, usable_device
from crptpro.objectives import AveragedSACLoss, Method, RADSACLoss, SkillDDPGLoss, get_method, method_of
from crptpro.seeding import derive_seed
from crptpro.training.agent import PixelAgent, SACLearner
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.env_thread import SPARE_FRAMES, EnvThread, make_replay
from crptpro.training.pretrain import (
    SHIFT_PAD,
    PretrainResult,
    describe_loss,
    ending,
    make_optimizer,
    make_update,
    scalars,
    training_dtype,
    write_row,
)
from crptpro.training.run import Generators, Run
from crptpro.transforms import ContrastiveReward, FrozenEncoder, ParticleReward, PrototypeReward, RandomShift
from crptpro.values import Quality, check_numbers

logger = logging.getLogger(__name__)

DISCOUNT = 0.99


@dataclass(frozen=True)
class ExploreConfig:
    """How agents explore while an encoder is pre-trained. ``None`` means the method's own value.

    Source: Proto-RL's released agent (denisyarats/proto) and CRPTpro's comparison of it across domains. Every interval
    counts a domain's own agent steps.
    """

    env_steps: int | None = None
    """budget in simulator steps, shared by all domains (None: the method's; -c 200,000, -s 500,000)"""
    batch_size: int | None = None
    """transitions per update, of encoder and agent alike (None: the method's)"""
    learning_rate: float | None = None
    """of the encoder's Adam (None: the method's)"""
    encoder_update_interval: int | None = None
    """agent steps in a domain between two encoder updates on it (None: the method's, 2)"""
    random_agent_steps: int | None = None
    """agent steps per domain taken uniformly at random before its first update (None: the method's)"""
    replay_capacity: int | None = None
    """transitions kept per domain (None: the method's, 100,000)"""
    hidden_dim: int = 1_024
    """width of the two hidden layers of the agents' actors and critics"""
    queue_size: int = 2_048
    """candidates that the prototype reward keeps, a multiple of the number of prototypes"""
    seed: int = 0
    """seeds agents, environments, exploration, sampling and shifts"""
    quality: Quality = "exact"
    """render quality"""
    precision: Precision = "auto"
    """auto is bf16 where faster, fp32 for your own loss or network. Deviation: the released code uses fp32"""
    device: str = "cpu"
    """device of all networks"""
    log_interval: int = 50
    """encoder updates between two rows of the record"""
    checkpoint_interval_env_steps: int = 5_000
    """simulator steps, over all domains, between two checkpoints"""

    def __post_init__(self) -> None:
        check_numbers(self, minima={"random_agent_steps": 0}, maxima={})

    def resolved(self, method: Method) -> Any:
        owners = {"batch_size": method, "learning_rate": method}
        left_open = [name for name, value in vars(self).items() if value is None]
        return dataclasses.replace(self, **{n: getattr(owners.get(n, method.exploration), n) for n in left_open})


@dataclass(frozen=True)
class ExplorationPlan:
    """How many agent steps and updates an active pre-training makes; domains take turns, one agent step each."""

    repeats: tuple[int, ...]  # simulator steps per agent step, of each domain; ``env_steps`` are over all
    agent_steps: int  # of each domain
    first_update: int  # agent step of a domain from which on updates follow
    encoder_update_interval: int  # in a domain's own agent steps
    encoder_updates_each: int  # encoder updates after each interval

    @property
    def decisions(self) -> int:
        return self.agent_steps * len(self.repeats)

    @property
    def env_steps(self) -> int:
        return self.agent_steps * sum(self.repeats)

    @property
    def encoder_updates(self) -> int:
        interval = self.encoder_update_interval
        times = max(0, -(-self.agent_steps // interval) - -(-self.first_update // interval))
        return times * self.encoder_updates_each * len(self.repeats)


def plan_exploration(
    method: Method, domains: Sequence[str | Domain], config: ExploreConfig | None = None
) -> ExplorationPlan:
    """Spread a method's budget over domains; refused if the method does not explore, or would learn nothing."""
    if method.exploration is None:
        raise CRPTproError(
            f"{method.name} learns from datasets and does not explore; use pretrain(), or name a method that explores."
        )
    settings = (config or ExploreConfig()).resolved(method)
    repeats = tuple(resolve_action_repeat(domain) for domain in domains)
    plan = ExplorationPlan(
        repeats,
        agent_steps=-(-settings.env_steps // sum(repeats)),
        first_update=max(settings.random_agent_steps, method.exploration.n_step),
        encoder_update_interval=settings.encoder_update_interval,
        encoder_updates_each=method.exploration.encoder_updates_each,
    )
    if not plan.encoder_updates:
        raise CRPTproError(
            f"{settings.env_steps:,} env steps are {plan.agent_steps:,} agent steps per domain, of which the first "
            f"{plan.first_update:,} come without updates: nothing would be learned. Use more env_steps or fewer "
            "random_agent_steps."
        )
    return plan


@dataclass(frozen=True)
class ExploreResult(PretrainResult):
    """How an active pre-training ended."""

    env_steps: int = 0
    """simulator steps over all domains"""
    actor: nn.Module | None = field(default=None, repr=False)
    """the exploring actor, for a method whose downstream runs start from it"""
    queue: Tensor | None = field(default=None, repr=False)
    """candidates of the prototype reward, float32 ``[queue_size, D]``, the oldest first"""


def pretrain_active(
    loss: LossModule,
    domains: str | Domain | Sequence[str | Domain],
    *,
    method: str | None = None,
    run_dir: str | Path | None = None,
    config: ExploreConfig | None = None,
    records: RunLogger | None = None,
    progress: bool = True,
    **overrides: Any,
) -> ExploreResult:
    """Train a self-supervised loss on what exploring agents see (Proto-RL, APT, BeCL; here also across domains).

    The domains take turns, one agent step each. Each has its own environment, replay, actor, critic and temperature;
    encoder, heads, prototypes and their optimiser are shared. Its agent learns from the intrinsic reward alone, the
    encoder from the self-supervised loss alone, on batches of one domain at a time.

    Deviation: neither the paper nor the released code says how its cross-domain active baselines are built. Turns,
    shared candidates and schedules in a domain's own agent steps are this project's choice.

    ``domains`` are one or several, by domain or task name. ``run_dir`` gets records (``pretrain.csv``, ``explore.csv``,
    ``episodes.csv``), replays and checkpoints; the same call with a new loss resumes. ``overrides`` are single settings
    of :class:`ExploreConfig`; the other arguments are those of :func:`~crptpro.training.pretrain`.

    Raises:
        CRPTproError: several domains for a single-domain method, or a budget too small for any update; otherwise as
            :func:`~crptpro.training.pretrain`.
    """
    recipe = method_of(loss) if method is None else get_method(method)
    given = dataclasses.replace(config or ExploreConfig(), **overrides)
    named = _named(domains, recipe)
    plan = plan_exploration(recipe, list(named.values()), given)
    places = [describe_domain(domain) for domain in named.values()]
    exploration: Any = recipe.exploration
    settings = given.resolved(recipe)
    if isinstance(kind := exploration.reward, str):
        for name in ("projector", "prototypes") if kind == "prototype" else ("projector",):
            if getattr(loss, name, None) is None:
                raise CRPTproError(f"The {kind} reward needs a loss with {name}; {type(loss).__name__} has none.")
    if kind == "prototype" and settings.queue_size % (count := len(loss.prototypes.weight)):
        raise ValueError(f"queue_size must be a multiple of num_prototypes, got {settings.queue_size} and {count}.")
    device = usable_device(settings.device)
    loss.to(device).train()
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(Run(run_dir, unit="env_steps", streams=("pretrain", "explore", "episodes"),
                                      records=records, config=settings, progress=progress))  # fmt: skip
        dtype = training_dtype(run, loss, settings.precision, device)
        stack.enter_context(computing(loss, dtype))
        run.require_same({
            **{k: v for k, v in dataclasses.asdict(settings).items() if k not in ("device", "log_interval")},
            "domains": [{**where, "action_repeat": repeat} for where, repeat in zip(places, plan.repeats)],
            "precision": PRECISION_NAMES[dtype], "loss": describe_loss(loss),
            "exploration": {**dataclasses.asdict(exploration), "reward": _described(exploration.reward)},
        })  # fmt: skip
        torch.manual_seed(derive_seed(settings.seed, "active", "loss"))
        capacity = min(settings.replay_capacity, plan.agent_steps)
        slack = 4 * (settings.checkpoint_interval_env_steps // sum(plan.repeats)) + SPARE_FRAMES
        if run.run_dir is not None and not run.saved:
            needed = len(named) * (capacity + slack) * 3 * images_of(loss.encoder)["image_size"] ** 2
            logger.info("replays: %.2f GB in %s; they are kept", needed / 1e9, run.run_dir / "replay")
            replays = [dataset_path(run.run_dir / "replay", name) for name in named]
            # Those of an attempt without a checkpoint are replaced.
            held = sum(file.stat().st_size for replay in replays for file in replay.glob("*.memmap*"))
            require_disk(run.run_dir, max(0, needed - held), "The replays of the domains")
        recipe = dataclasses.replace(recipe, learning_rate=settings.learning_rate, updates=plan.encoder_updates)
        optimizer, schedule, targets = make_optimizer(loss, recipe)
        monitor = CollapseMonitor.of(loss)
        explorers: list[Explorer] = []
        for name, domain in named.items():
            # The domains share the candidates of the prototype reward.
            shared = explorers[0].reward if explorers and exploration.reward == "prototype" else None
            explorers.append(Explorer(name, domain, loss, exploration, settings, run, capacity=capacity, slack=slack,
                                      dtype=dtype, reward=shared))  # fmt: skip
            stack.callback(explorers[-1].env.close)
        done = run.counters
        done["updates"] = 0
        run.keep(loss=loss, optimizer=optimizer, schedule=schedule, targets=targets, monitor=monitor,
                 **{f"explorer_{index}": explorer for index, explorer in enumerate(explorers)})  # fmt: skip

        update_encoder = make_update(loss, optimizer, targets, grad_clip=recipe.grad_clip)
        for _ in run.until(plan.env_steps, checkpoint_interval=settings.checkpoint_interval_env_steps):
            explorer = min(explorers, key=lambda each: each.agent_steps)  # they take turns
            agent_step = explorer.agent_steps
            explorer.begin_step()  # the next observation is rendered while the updates compute
            run.advance(explorer.action_repeat)
            learns = agent_step >= plan.first_update
            trains_encoder = learns and agent_step % plan.encoder_update_interval == 0
            trains_agent = learns and agent_step % exploration.agent_update_interval == 0
            for left in reversed(range(plan.encoder_updates_each if trains_encoder else 0)):
                # The replay's transform is the random shift, drawn anew for every image.
                batch = explorer.replay.sample(settings.batch_size).to(device)
                if exploration.encodes_before_update and not left:
                    batch = explorer.encode(batch)
                losses = update_encoder(batch)
                schedule.step()
                done["updates"] += 1
                run.log(scalars(losses, explorer.name))
                if done["updates"] % settings.log_interval == 0:
                    write_row(run, loss, monitor, done["updates"])
                    run.write("explore", updates=done["updates"])
            if trains_agent:
                batch = batch if trains_encoder else explorer.replay.sample(settings.batch_size).to(device)
                if "features" not in batch:
                    batch = explorer.encode(batch)
                metrics = explorer.learn(batch, agent_step // exploration.agent_update_interval)
                run.log({f"{key}/{explorer.name}": value for key, value in metrics.items()}, "explore")
            if (row := explorer.end_step()) is not None:
                run.write("episodes", row, updates=done["updates"], episodes=explorer.episodes)
        run.finish()
        if run.means("pretrain"):
            write_row(run, loss, monitor, done["updates"])
            run.write("explore", updates=done["updates"])
        explored = [
            {**where, "agent_steps": e.agent_steps, "episodes": e.episodes} for where, e in zip(places, explorers)
        ]
        facts = {"device": str(device), "datasets": explored, "env_steps": run.position}
        first = explorers[0]
        return ExploreResult(
            **ending(run, loss, recipe, monitor, done["updates"], facts), env_steps=run.position,
            actor=first.agent.actor if exploration.transfers_actor else None, queue=first.candidates(),
        )  # fmt: skip


def _described(reward: Any) -> Any:
    """Return the name of a reward, or of a function that makes one, with the arguments of a partial one."""
    if isinstance(reward, functools.partial):
        return {"function": _described(reward.func), "args": list(reward.args), "keywords": reward.keywords}
    return reward if isinstance(reward, str) else getattr(reward, "__qualname__", type(reward).__qualname__)


class Explorer:
    """One domain of an active pre-training: its environment, replay, agent and intrinsic reward.

    A checkpoint holds no simulator state: the running episode is replayed from its seed with the same actions. A
    non-deterministic environment does not reproduce it, which is logged as a warning.
    """

    def __init__(
        self, name: str, domain: str | Domain, loss: LossModule, exploration: Any, config: Any, run: Run, *,
        capacity: int, slack: int, dtype: torch.dtype, reward: Transform | None,
    ) -> None:  # fmt: skip
        self.name, self.loss, self.config, self.exploration = name, loss, config, exploration
        self.seed = derive_seed(config.seed, "active", name)
        self.device = torch.device(config.device)
        self.action_repeat = resolve_action_repeat(domain)
        self.env = EnvThread(domain, loss.encoder, config, seed=self.seed, action_repeat=self.action_repeat)
        names = ("replay", "shift", "policy", "random_actions", "skill", "reward")
        self.generators = Generators(self.seed, *names)
        torch.manual_seed(derive_seed(self.seed, "agent"))  # its networks do not depend on other domains
        self.learner = self._make_learner(loss.encoder.feature_dim, self.env.env.action_spec.shape[-1])
        set_compute_dtype(self.learner.loss, dtype)
        self.agent = PixelAgent(loss.encoder, self.learner.loss.actor)
        self.networks = [self.learner.loss]
        self.reward = self._make_reward() if reward is None else reward
        # A finished run needs neither its replay, which may have been deleted, nor its last episode.
        self._is_finished = bool(run.saved.get("is_finished"))
        path = None if run.run_dir is None else dataset_path(run.run_dir / "replay", name)
        if self._is_finished:
            path, capacity, slack = None, self.exploration.n_step, 0
        self.replay = self._make_replay(run, path, capacity, slack)
        self._parts = {**self.learner.components(), "reward": self.reward, "generators": self.generators}
        if not self._is_finished:
            self._parts["replay"] = self.replay
        self.agent_steps = self.episodes = self.skill = 0
        self.actions: list[Tensor] = []  # of the running episode
        self._td: TensorDictBase | None = None  # its newest observation
        self._episode_return = 0.0

    def begin_step(self) -> None:
        """Choose an action, at first uniformly at random, and begin the environment's step."""
        td = self._td = self._reset() if self._td is None else self._td
        skills = self.exploration.skill_dim
        if skills is not None:
            if len(self.actions) % self.exploration.skill_agent_steps == 0:
                self.skill = int(torch.randint(skills, (), generator=self.generators["skill"], device="cpu"))
            td["skill"] = nn.functional.one_hot(torch.tensor(self.skill, device="cpu"), skills).float()
        if self.agent_steps < self.config.random_agent_steps:
            td["action"] = self.env.uniform_action(self.generators["random_actions"])
        else:
            features, skill = self.agent.encode(td["pixels"]), td.get("skill", None)
            td["action"] = self.agent.explore(features, self.generators["policy"], skill=skill)
        self._step = self.env.step(td)

    def end_step(self) -> dict[str, Any] | None:
        """Store the outcome of the step; returns the domain, return and length of the episode if it ended one."""
        transition = self._step.result()
        self.replay.extend(transition)
        self.agent_steps += 1
        self._take(transition)
        if not transition["next", "done"].item():
            return None
        episode = {"episode_return": self._episode_return, "episode_agent_steps": len(self.actions)}
        self.episodes += 1
        self._td, self.actions, self._episode_return = None, [], 0.0
        return {"domain": self.name, **episode}

    def learn(self, batch: TensorDictBase, agent_update: int) -> dict[str, Tensor]:
        """Let the agent learn from the intrinsic reward of a batch with features; returns detached scalars."""
        batch = self.reward(batch)
        intrinsic = batch["next", "intrinsic_reward"]
        batch["next", "reward"] = intrinsic
        losses = self.learner.update(batch, agent_update=agent_update)
        return {"intrinsic_reward": intrinsic.mean(), **dict(losses.items())}

    def candidates(self) -> Tensor | None:
        """Return the candidates of a prototype reward, oldest first."""
        if not isinstance(self.reward, PrototypeReward):
            return None
        return self.reward.queue.roll(-int(self.reward.queue_pointer), 0).clone()

    def state_dict(self) -> dict[str, Any]:
        return {
            "counters": [self.agent_steps, self.episodes, self.skill],
            "actions": torch.stack(self.actions) if self.actions else None,
            **{name: part.state_dict() for name, part in self._parts.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`; the episode that was running is replayed."""
        self.agent_steps, self.episodes, self.skill = state["counters"]
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        if state["actions"] is None or self._is_finished:
            return
        self._td = self._reset()
        for action in state["actions"]:
            self._td["action"] = action
            self._take(self.env.step(self._td).result())
        newest = self.replay.observations(torch.tensor([self.replay.frames_written - 1], device="cpu"))[0]
        if not torch.equal(newest, self._td["pixels"]):
            logger.warning("%s does not repeat its episode: this run will differ from an uninterrupted one.", self.name)

    def _reset(self) -> TensorDictBase:
        return self.env.reset(derive_seed(self.seed, "active", self.name, "episode", self.episodes))

    def _take(self, transition: TensorDictBase) -> None:
        self.actions.append(transition["action"].clone())
        self._episode_return += transition["next", "reward"].item()
        self._td = step_mdp(transition)

    def _make_learner(self, feature_dim: int, action_dim: int) -> SACLearner:
        skills, hidden_dim = self.exploration.skill_dim, self.config.hidden_dim
        generator = self.generators["policy"]
        if self.exploration.agent == "skill-ddpg":
            policy = DeterministicActor(feature_dim, action_dim, skill_dim=skills, hidden_dim=hidden_dim)
            critic = TwinCritic(feature_dim + skills, action_dim, hidden_dim=hidden_dim, has_tanh=True)
            ddpg = SkillDDPGLoss(policy.to(self.device), critic.to(self.device), gamma=DISCOUNT, generator=generator)
            return SACLearner(ddpg, interval=1)
        sac_class = {"rad-sac": RADSACLoss, "averaged-sac": AveragedSACLoss}[self.exploration.agent]
        actor = SquashedGaussianActor(feature_dim, action_dim, hidden_dim=hidden_dim)
        critic = TwinCritic(feature_dim, action_dim, hidden_dim=hidden_dim)
        sac = sac_class(actor.to(self.device), critic.to(self.device), gamma=DISCOUNT, generator=generator)
        return SACLearner(sac)

    def _make_reward(self) -> Transform:
        loss, generator, kind = self.loss, self.generators["reward"], self.exploration.reward
        if callable(kind):  # a registered method's own function
            return kind(loss, generator).to(self.device)
        reward: Transform
        if kind == "prototype":
            reward = PrototypeReward(
                loss.projector, loss.prototypes, coef=None, generator=generator, queue_size=self.config.queue_size
            )
            reward.warn_if_mostly_zero(self.config.batch_size)
        elif kind == "particle":
            reward = ParticleReward(loss.projector)
        else:
            reward = ContrastiveReward(loss.projector, temperature=float(loss.temperature))
        return reward.to(self.device)

    def _make_replay(self, run: Run, path: Path | None, capacity: int, slack: int) -> FrameReplay:
        skills = self.exploration.skill_dim
        replay = make_replay(
            run, path, self.env.env, capacity, slack=slack, n_step=self.exploration.n_step, discount=DISCOUNT,
            extra_columns=None if skills is None else {"skill": ((skills,), torch.float32)},
            generator=self.generators["replay"],
        )  # fmt: skip
        images: list[Any] = ["pixels", ("next", "pixels")]
        features: list[Any] = ["features", ("next", "features")]
        second_views: list[Any] = []
        views: dict[Any, Any] = dict(getattr(self.loss, "views", {}))
        if isinstance(self.learner.loss, AveragedSACLoss):
            second_views = ["pixels_view", ("next", "pixels_view")]
            views |= zip(second_views, images)
            features += ["features_view", ("next", "features_view")]
        read, written = [*views.values(), *images], [*views, *images]
        generator = self.generators["shift"]
        replay.append_transform(RandomShift(pad=SHIFT_PAD, in_keys=read, out_keys=written, generator=generator))
        # Adds the features of every image to a batch, without gradient.
        self.encode = FrozenEncoder(self.loss.encoder, in_keys=[*images, *second_views], out_keys=features)
        return replay


def _named(domains: str | Domain | Sequence[str | Domain], method: Method) -> dict[str, Domain]:
    listed = [get_domain(domain) for domain in ([domains] if isinstance(domains, (str, Domain)) else domains)]
    named = {domain.name: domain for domain in listed}
    if not named:
        raise CRPTproError("Name at least one domain to explore.")
    for name in named:
        if not name.isprintable() or {",", '"'} & set(name):
            raise CRPTproError(f"The domain {name!r} cannot name columns of a record; rename it.")
    if len({dataset_path("", name) for name in named}) < len(listed):
        names = ", ".join(d.name for d in listed)
        raise CRPTproError(f"A domain is named twice, or two share a directory: {names}. Each has one agent.")
    if method.exploration is not None and method.exploration.is_single_domain and len(named) > 1:
        raise CRPTproError(
            f"{method.name} pre-trains on one domain, got {len(named)} ({', '.join(named)}). Run it once per domain, "
            "or use the method's cross-domain variant (-c)."
        )
    return named

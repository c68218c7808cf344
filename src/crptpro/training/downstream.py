"""Downstream reinforcement learning: SAC on a frozen encoder with an exploration bonus, or DrQ end to end."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn
from torchrl.envs import Compose, EnvBase
from torchrl.envs.utils import step_mdp

from crptpro.artifact import require_replaceable
from crptpro.data import FrameReplay
from crptpro.domains import LONGEST_EPISODE_AGENT_STEPS, Domain, describe_domain, get_domain
from crptpro.envs import resolve_action_repeat
from crptpro.envs.factory import episode_length
from crptpro.errors import CheckpointError, PretrainedError
from crptpro.free_memory import free_bytes
from crptpro.logging import RunLogger
from crptpro.modules import SquashedGaussianActor, TwinCritic, resolve_precision, set_compute_dtype, usable_device
from crptpro.modules.precision import PRECISION_NAMES, Precision
from crptpro.objectives import DrQLoss, RADSACLoss, get_method, method_names
from crptpro.objectives.base import require_positive
from crptpro.objectives.methods import DOWNSTREAM
from crptpro.pretrained import Pretrained, domains_seen, load_pretrained, random_pretrained, require_saveable
from crptpro.provenance import cpu_cores
from crptpro.seeding import derive_seed, seed_everything
from crptpro.training.agent import AGENT_FORMAT, PixelAgent, SACLearner, save_agent
from crptpro.training.env_thread import SPARE_FRAMES, EnvThread, make_replay
from crptpro.training.evaluate import WORKER_BYTES, Episode, Evaluator, summarize
from crptpro.training.pretrain import SHIFT_PAD
from crptpro.training.run import Generators, Run
from crptpro.transforms import DenseShiftFeatures, FrozenEncoder, PrototypeReward, RandomShift, choose_feature_mode
from crptpro.transforms.dense_shift import dense_shift_geometry
from crptpro.values import Colors, Quality, as_path, check_numbers
from crptpro.workers import can_be_sent

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DownstreamConfig:
    """How a task is learned, by one update per agent step. ``None`` means the method's own value.

    Source: CRPTpro, hyper-parameter table; Proto-RL's released agent.
    """

    env_steps: int | None = None
    """budget in simulator steps (None: the method's; 500,000, drq 1,000,000); an episode running then is cut"""
    batch_size: int = 512
    """transitions per update"""
    replay_capacity: int | None = None
    """transitions kept (None: the method's; 40,000, proto-rl and drq 100,000); the oldest go first"""
    random_agent_steps: int = 1_000
    """agent steps before the first update, uniformly at random unless the actor has explored the domain (proto-rl-s)"""
    intrinsic_reward_coef: float | None = None
    """weight of the prototype-kNN bonus (None: the method's; 0.2 for those with prototypes); 0 switches it off"""
    knn_k: int = 3
    """the bonus is the distance to the k-th nearest candidate"""
    queue_size: int | None = None
    """candidates kept, a multiple of the number of prototypes (None: as many as the artifact holds, else 2,048)"""
    hidden_dim: int = 1_024
    """width of the two hidden layers of actor and critic"""
    discount: float = 0.99
    """per agent step; only true terminations stop bootstrapping, time limits never do"""
    learning_rate: float | None = None
    """of the Adam optimisers of actor, critic and temperature (None: the method's; 1e-4, drq 1e-3)"""
    initial_temperature: float = 0.1
    """SAC's initial alpha"""
    critic_tau: float = 0.01
    """EMA rate of the target critic, at every second update"""
    action_repeat: int | None = None
    """simulator steps per agent step (None: the domain's, 2)"""
    features: Literal["auto", "dense", "dense-bf16", "reencode"] = "auto"
    """crops of dense maps (exact; dense-bf16: rounded, half the memory) or re-encoding; auto is dense where it fits"""
    eval_interval_env_steps: int = 10_000
    """simulator steps between two evaluations; the first is at 0, the last at the end"""
    eval_episodes: int = 10
    """episodes per evaluation"""
    eval_workers: int | None = None
    """processes that evaluate during training, 0.5 GB each; 0 interrupts training (None: one per core if that helps)"""
    checkpoint_interval_env_steps: int = 5_000
    """simulator steps between two checkpoints, taken at episode ends"""
    log_interval_env_steps: int = 1_000
    """simulator steps between two rows of training metrics"""
    seed: int = 0
    """seeds initialisation, environment, exploration, sampling, shifts, bonus and evaluation"""
    quality: Quality = "exact"
    """render quality"""
    colors: Colors = "normal"
    """colours of the task: reversed_background are the paper's unseen ones, reversed_image works everywhere"""
    precision: Precision = "auto"
    """auto is bf16 where faster, fp32 for your own networks. Deviation: the released code uses fp32"""
    compile: bool = False
    """compile the losses with torch.compile; changes rounding only"""
    cuda_graph: bool = False
    """on a GPU, record the update as CUDA graphs and replay them"""
    device: str = "cpu"
    """device of networks and features"""

    def __post_init__(self) -> None:
        check_numbers(self, minima={"eval_workers": 0}, maxima={"discount": 1, "critic_tau": 1})
        require_positive(initial_temperature=self.initial_temperature)
        if self.features not in ("auto", "dense", "dense-bf16", "reencode"):
            raise ValueError(f"`features` must be auto, dense, dense-bf16 or reencode, got {self.features!r}.")
        if self.replay_capacity is not None and self.replay_capacity < self.random_agent_steps:
            raise ValueError(
                f"`replay_capacity` ({self.replay_capacity}) must hold the {self.random_agent_steps} transitions of "
                "`random_agent_steps`, or no update would ever start."
            )

    def resolved(self, task: str | Domain, pretrained: Pretrained) -> Any:
        """Return the settings with the method's and the domain's values where they are ``None``."""
        known = pretrained.method in method_names(presets=True)
        own = DOWNSTREAM | dict(get_method(pretrained.method).downstream if known else {})
        values: dict[str, Any] = {name: value for name, value in own.items() if getattr(self, name) is None}
        if "replay_capacity" in values:
            values["replay_capacity"] = max(values["replay_capacity"], self.random_agent_steps)
        if self.queue_size is None:
            values["queue_size"] = 2_048 if pretrained.queue is None else len(pretrained.queue)
        if self.action_repeat is None:
            values["action_repeat"] = resolve_action_repeat(task)
        return dataclasses.replace(self, **values)


@dataclass(frozen=True)
class DownstreamResult:
    """The result of a downstream run."""

    agent: PixelAgent
    """callable as a deterministic policy"""
    evaluations: list[dict[str, Any]]
    """one row per evaluated episode: ``env_steps``, ``episode``, ``episode_return``, ..."""
    agent_path: Path | None
    """artifact of the agent; ``None`` without a run directory"""
    env_steps: int
    """simulator steps taken"""


def train_downstream(
    task: str | Domain,
    pretrained: Pretrained | str | Path,
    *,
    run_dir: str | Path | None = None,
    config: DownstreamConfig | None = None,
    records: RunLogger | None = None,
    progress: bool = True,
    **overrides: Any,
) -> DownstreamResult:
    """Learn a task with SAC on a frozen encoder (CRPTpro, Sec. III-C), or with DrQ, which trains its own encoder.

    ``task`` is any name that :func:`crptpro.envs.make_env` knows, or a :class:`~crptpro.domains.Domain`; ``pretrained``
    an artifact, its directory, the name of an encoder that ships, or one of the controls ``"random-encoder"`` and
    ``"drq"``. ``run_dir`` gets records (``eval.csv``, ``train.csv``, ``episodes.csv``), checkpoints, replay and agent.
    The same call continues from the newest checkpoint, taken between two episodes; on a CPU, a kill changes no number.
    ``overrides`` are single settings of :class:`DownstreamConfig`; the rest as in :func:`~crptpro.training.pretrain`.

    Raises:
        PretrainedError: the artifact cannot be read, or the encoder cannot be saved.
        CheckpointError: ``run_dir`` holds a run of other settings (named), or one whose replay is missing.
        CRPTproError: ``run_dir`` holds other files where the agent will be.
        NonFiniteError: a loss, a weight, an action or a reward is not finite; the last checkpoint is kept.
        DiskSpaceError: the disk cannot hold the replay.
    """
    settings: Any = dataclasses.replace(config or DownstreamConfig(), **overrides)
    source, is_control = "", False
    if not isinstance(pretrained, Pretrained):
        if not isinstance(pretrained, (str, Path)):
            kind = type(pretrained).__name__
            raise PretrainedError(
                f"A {kind} is not a saved encoder: pass what save_pretrained(result, path) returns, or "
                "Pretrained(encoder)."
            )
        source, is_control = str(pretrained), str(pretrained) in ("drq", "random-encoder")
        pretrained = random_pretrained(settings.seed, method=source) if is_control else load_pretrained(source)
    if run_dir is not None:
        require_saveable(Pretrained(pretrained.encoder))  # the agent will hold it
        require_replaceable(as_path(run_dir, "run_dir") / "agent", AGENT_FORMAT)
    settings = settings.resolved(task, pretrained)
    if pretrained.method == "drq" and (settings.intrinsic_reward_coef > 0 or settings.features != "auto"):
        raise ValueError("drq trains its encoder: it has no bonus (`intrinsic_reward_coef`) and no kept `features`.")
    if settings.intrinsic_reward_coef > 0 and pretrained.prototypes is not None:  # refused before anything is written
        PrototypeReward(
            None, pretrained.prototypes, knn_k=settings.knn_k, queue_size=settings.queue_size, queue=pretrained.queue
        )
    where = describe_domain(task)
    name = where["task"]
    if settings.features in ("dense", "dense-bf16"):
        dense_shift_geometry(pretrained.encoder)
    # A control's weights may differ in the last digit on another machine; a resumed run has those of its checkpoint.
    identity = f"{source}:seed {settings.seed}" if is_control else pretrained.identity()
    seen = domains_seen(pretrained.card)
    what = {**where, "pretrained": identity, "pretrained_on": ", ".join(sorted(seen))}
    device = usable_device(settings.device)
    repeat = settings.action_repeat
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(Run(run_dir, unit="env_steps", streams=("train", "episodes", "eval"), records=records,
                                      config={**what, **dataclasses.asdict(settings)}, progress=progress))  # fmt: skip
        networks = (pretrained.encoder, pretrained.projector, pretrained.prototypes)
        dtype = resolve_precision(run.saved_setting("precision", settings.precision), device, *networks)
        # The budget may grow, and machines differ; everything else decides the numbers of the run.
        free = ("env_steps", "eval_workers", "compile", "device", "features")
        run.require_same({
            **what, **{key: value for key, value in dataclasses.asdict(settings).items() if key not in free},
            "precision": PRECISION_NAMES[dtype], "features": run.saved_setting("features", "auto"),
        })  # fmt: skip
        run.settings["features"] = run.saved_setting("features", settings.features)
        seed_everything(derive_seed(settings.seed, "downstream"))
        generators = Generators(settings.seed, "replay", "shift", "bonus", "policy", "random_actions")
        env = EnvThread(task, pretrained.encoder, settings, seed=settings.seed, action_repeat=repeat)
        stack.callback(env.close)
        encoder = _frozen_copy(pretrained.encoder, device, dtype)
        actor, action_dim = pretrained.actor, env.env.action_spec.shape[-1]
        # Proto-RL(S): it starts as the actor that explored the task's own domain.
        has_explored = isinstance(actor, SquashedGaussianActor) and actor.config["action_dim"] == action_dim
        has_explored = has_explored and (not seen or where["domain"] in seen)
        learner, agent = _make_agent(pretrained, encoder, action_dim, settings, generators["policy"], has_explored)
        set_compute_dtype(learner.loss, dtype)
        evaluator = Evaluator(env.make_env, agent, episodes=settings.eval_episodes, seed=settings.seed,
                              workers=_eval_workers(name, env.make_env, settings), progress=progress,
                              on_result=functools.partial(_record_evaluation, run, name, pretrained.label))  # fmt: skip
        stack.callback(evaluator.close)
        is_complete = bool(run.saved.get("is_finished")) and run.saved["position"] >= settings.env_steps
        replay = _make_replay(run, task, env.env, settings, generators["replay"], is_complete=is_complete)
        attach_transforms(replay, pretrained, encoder, settings, generators, run, dtype=dtype,
                          observations=most_observations(task, settings.env_steps, repeat),
                          reserved_bytes=evaluator.workers * WORKER_BYTES)  # fmt: skip
        dense = next((each for each in replay.transform if isinstance(each, DenseShiftFeatures)), None)
        if dense is not None:  # its replay refers to it, too: the maps would stay until cycles are collected
            stack.callback(dense.forget)
        counters = run.counters
        counters.update(updates=0, episodes=0, last_evaluation=-1)
        run.keep(**learner.components(), generators=generators, evaluator=evaluator,
                 control=encoder if source == "random-encoder" else None,
                 replay=None if is_complete else replay)  # fmt: skip

        if run.position < settings.env_steps <= repeat * settings.random_agent_steps:
            logger.warning(
                "%s env steps end before the first update, which comes after %s agent steps of %d env steps each.",
                f"{settings.env_steps:,}", f"{settings.random_agent_steps:,}", repeat,
            )  # fmt: skip

        def start_evaluation() -> None:
            agent_steps = run.position // repeat
            evaluator.start(env_steps=run.position, agent_steps=agent_steps, updates=counters["updates"])
            counters["last_evaluation"] = run.position

        interval = settings.eval_interval_env_steps
        budget = -(-settings.env_steps // repeat) * repeat
        for first in run.until(budget, checkpoint_interval=settings.checkpoint_interval_env_steps):
            evaluator.poll()
            if first // interval > counters["last_evaluation"] // interval:
                start_evaluation()
            td = env.reset(derive_seed(settings.seed, "downstream", "episode", counters["episodes"]))
            episode_return, done, number = 0.0, False, None
            while not done and run.position < settings.env_steps:
                agent_step = run.position // repeat
                learns = agent_step >= settings.random_agent_steps
                if not (learns or has_explored):
                    td["action"] = env.uniform_action(generators["random_actions"])
                else:
                    if dense is None or number is None:  # the first observation of an episode is not stored yet
                        features = agent.encode(td["pixels"])
                    else:  # encoded once, for the policy and for the batches that will contain it
                        features = dense.unshifted(number)
                    td["action"] = agent.explore(features, generators["policy"])
                step = env.step(td)  # the next observation is rendered while the update computes
                if learns:
                    # The sample has features under random shifts, and the bonus is part of its reward.
                    batch = replay.sample(settings.batch_size).to(device)
                    run.log(learner.update(batch, agent_update=agent_step))
                    if (intrinsic := batch.get(("next", "intrinsic_reward"), None)) is not None:
                        run.log({"intrinsic_reward": intrinsic.mean()})
                    counters["updates"] += 1
                transition = step.result()
                replay.extend(transition)
                number = replay.frames_written - 1
                episode_return += transition["next", "reward"].item()
                done = bool(transition["next", "done"].item())
                td = step_mdp(transition)
                run.advance(repeat)
                if run.every(settings.log_interval_env_steps) and run.means("train"):
                    row = run.write("train", updates=counters["updates"])
                    run.show(q=row["q_mean"])
            counters["episodes"] += 1
            if done:  # and not cut by the budget
                ended = {"episode_return": episode_return, "episode_agent_steps": (run.position - first) // repeat}
                run.write("episodes", ended, episodes=counters["episodes"])

        if run.position != counters["last_evaluation"]:  # unless a finished run is called again
            run.save()  # a kill during the last evaluation costs no env step
            start_evaluation()
        evaluator.finish()
        run.finish()
        path = None
        if run.run_dir is not None:
            card = {**run.settings, "env_steps": run.position}
            path = save_agent(run.run_dir / "agent", agent, card=card)
            if run.records is not None:
                run.records.artifact(path, name=f"agent_{name}", kind="agent")
        return DownstreamResult(agent, run.rows("eval"), path, run.position)


def _frozen_copy(network: nn.Module, device: torch.device, dtype: torch.dtype) -> Any:
    return set_compute_dtype(copy.deepcopy(network).requires_grad_(False).eval().to(device), dtype)


def _make_agent(
    pretrained: Pretrained, encoder: Any, action_dim: int, config: Any, generator: torch.Generator, has_explored: bool
) -> tuple[SACLearner, PixelAgent]:
    """Return SAC on the encoder's features, or DrQ, whose critic trains the encoder, and the agent that acts."""
    device = torch.device(config.device)
    is_drq = pretrained.method == "drq"
    widths: dict[str, Any] = {"hidden_dim": config.hidden_dim, "has_tanh": is_drq}
    actor: Any = SquashedGaussianActor(encoder.feature_dim, action_dim, **widths)
    if has_explored:
        actor = copy.deepcopy(pretrained.actor)
        actor.requires_grad_(True).train()
    networks = actor.to(device), TwinCritic(encoder.feature_dim, action_dim, **widths).to(device)
    options: dict[str, Any] = {"gamma": config.discount, "alpha_init": config.initial_temperature}
    make_loss = functools.partial(DrQLoss, encoder.requires_grad_(True)) if is_drq else RADSACLoss
    # A CUDA graph draws from the generator of its device.
    loss = make_loss(*networks, **options, generator=generator if device.type == "cpu" else None)
    rates = {"learning_rate": config.learning_rate, "critic_tau": config.critic_tau}
    learner = SACLearner(loss, compile=config.compile, cuda_graph=config.cuda_graph, **rates)
    return learner, PixelAgent(encoder, loss.actor)


def _make_replay(
    run: Run, task: str | Domain, env: EnvBase, config: Any, generator: torch.Generator, *, is_complete: bool
) -> FrameReplay:
    """Return the replay in the run's directory; a complete run needs none, and gets one of capacity 1."""
    if is_complete:
        return make_replay(run, None, env, 1, generator=generator)
    path = None if run.run_dir is None else run.run_dir / "replay"
    if path is not None and run.saved and not path.exists():
        raise CheckpointError(
            f"{run.run_dir} has done {run.saved['position']:,} env steps; to continue it needs its frames, and {path} "
            "is gone. Put it back, or start in another run directory."
        )
    # A checkpoint holds counters, not frames: frames of the last two must be kept until the next, at an episode's end.
    longest = episode_length(task, action_repeat=config.action_repeat) or LONGEST_EPISODE_AGENT_STEPS
    between = most_observations(task, config.checkpoint_interval_env_steps, config.action_repeat)
    slack = 2 * (between + longest) + SPARE_FRAMES
    if path is not None and not run.saved:
        size = (config.replay_capacity + slack) * 3 * env.observation_spec["pixels"].shape[-1] ** 2
        logger.info("replay: %.2f GB in %s; it is kept", size / 1e9, path)
    return make_replay(run, path, env, config.replay_capacity, slack=slack, generator=generator)


def most_observations(task: str | Domain, env_steps: int, action_repeat: int) -> int:
    """Return how many observations a run stores at most: one for each agent step, and one more for each episode."""
    agent_steps, length = -(-env_steps // action_repeat), episode_length(task, action_repeat=action_repeat)
    if length is None or get_domain(task).source not in ("suite", "manipulation"):
        return 2 * agent_steps  # an episode may end after any step
    # dm_control's have one length. An earlier smaller budget, which cut an episode, adds one.
    return agent_steps + -(-agent_steps // length) + max(16, agent_steps // 50)


class _Chain(Compose):
    """Stays one transform of a replay, whose checkpoint names transforms by their index."""


def attach_transforms(
    replay: FrameReplay,
    pretrained: Pretrained,
    encoder: Any,
    config: Any,
    generators: Mapping[str, torch.Generator],
    run: Run,
    *,
    dtype: torch.dtype,
    observations: int,
    reserved_bytes: int,
) -> None:
    """Attach to the replay what turns a sample into the learner's batch.

    DrQ reads two shifts of every image. SAC on a frozen encoder reads features under a random shift: crops of dense
    maps, or the shifted image encoded again. The bonus is added to the sampled reward. ``observations`` is how many the
    run stores at most.
    """
    device = torch.device(config.device)
    shift: dict[str, Any] = {"pad": SHIFT_PAD, "generator": generators["shift"]}
    pixels, features = ["pixels", ("next", "pixels")], ["features", ("next", "features")]
    if pretrained.method == "drq":
        views = ["pixels_view", ("next", "pixels_view")]
        replay.append_transform(RandomShift(in_keys=[*pixels, *pixels], out_keys=[*views, *pixels], **shift))
        return
    projector: Any = pretrained.projector
    prototypes: Any = pretrained.prototypes
    has_bonus = prototypes is not None and projector is not None and config.intrinsic_reward_coef > 0
    if has_bonus:
        projector, prototypes = [_frozen_copy(n, device, dtype) for n in (projector, prototypes)]
    elif config.intrinsic_reward_coef > 0:
        logger.info("no exploration bonus: the encoder of %s has no prototypes, or no projector", pretrained.label)
    # An update projects its whole batch, an agent step every shift of one observation.
    keeps_projections = has_bonus and config.batch_size >= 2 * (2 * SHIFT_PAD + 1) ** 2
    setting = run.settings["features"]
    is_rounded = setting == "dense-bf16"
    map_dtype = torch.bfloat16 if is_rounded else dtype
    slots = min(replay.window, observations)
    # The two modes round differently in bfloat16: a resumed run keeps its mode while that is possible.
    is_resumed = setting == "dense" and config.features == "auto"
    mode, reason = choose_feature_mode(
        "auto" if is_resumed else "dense" if is_rounded else setting, encoder, slots, map_dtype,
        available_bytes=max(0, free_bytes(device) - reserved_bytes),
        latent_dim=prototypes.weight.shape[1] if keeps_projections else None, share=1.0 if is_resumed else 0.8,
    )  # fmt: skip
    level = logging.WARNING if is_resumed and mode == "reencode" else logging.INFO
    logger.log(level, "features: %s", reason)
    run.settings["features"] = setting if is_rounded else mode
    if mode == "reencode":
        keeps_projections = False
        # Features, 40 times as large as a frame, need not move. TorchRL's DeviceCastTransform synchronises with the GPU
        # at every sample if the machine has one and `device` is the CPU.
        encode = FrozenEncoder(encoder, in_keys=pixels, out_keys=features)
        replay.append_transform(_Chain(lambda sample: sample.to(device), RandomShift(in_keys=pixels, **shift), encode))
    else:
        replay.storage.returns_pixels = False
        kept = projector if keeps_projections else None
        replay.append_transform(
            DenseShiftFeatures(encoder, replay, projector=kept, dtype=map_dtype, observations=slots, **shift)
        )
    if not has_bonus:
        return
    bonus = PrototypeReward(
        None if keeps_projections else projector,
        prototypes,
        in_keys=("next", "embedding" if keeps_projections else "features"),
        coef=config.intrinsic_reward_coef,
        knn_k=config.knn_k,
        queue_size=config.queue_size,
        queue=pretrained.queue,
        generator=generators["bonus"],
    )
    bonus.warn_if_mostly_zero(config.batch_size)
    replay.append_transform(bonus)


def _eval_workers(task: str, make_this_env: Callable[[], EnvBase], config: Any) -> int:
    """Return the number of evaluating processes: as set, or one per core if that works and helps."""
    if config.eval_workers is not None:
        if config.eval_workers and not can_be_sent(make_this_env):
            raise PretrainedError(
                f"eval_workers is {config.eval_workers}, but the environment of {task} cannot be built in another "
                "process: its make must be a function of an importable module. Move it there, or set eval_workers=0."
            )
        return config.eval_workers
    episodes = (-(-config.env_steps // config.eval_interval_env_steps) + 1) * config.eval_episodes
    workers = min(cpu_cores(), torch.get_num_threads())  # torch limited to one thread leaves the cores to other work
    return workers if workers > 1 and episodes >= 20 else 0  # starting one takes as long as an episode


def _record_evaluation(
    run: Run, task: str, method: str, episodes: Sequence[Episode], counters: Mapping[str, Any]
) -> None:
    for e in episodes:
        row = {"episode_return": e.episode_return, "episode_agent_steps": e.agent_steps, "seed": e.seed}
        run.write("eval", {**row, "method": method}, episode=e.episode, **counters)
    scores = summarize(episodes)
    logger.info(
        "%s: %s env steps, %s updates, return %.1f ± %.1f over %s",
        task, f"{counters['env_steps']:,}", f"{counters['updates']:,}", scores["mean"], scores["std"],
        "1 episode" if len(episodes) == 1 else f"{len(episodes)} episodes",
    )  # fmt: skip

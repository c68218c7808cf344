"""Downstream reinforcement learning: SAC on a frozen encoder with the prototype-kNN bonus (CRPTpro, Sec. III-C)."""

from __future__ import annotations

import dataclasses
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm.auto import tqdm

from crptpro.envs import make_env
from crptpro.errors import CheckpointError, NonFiniteError
from crptpro.loggers import RunLogger
from crptpro.pretrained import Pretrained, load_pretrained
from crptpro.seeding import derive_seed, global_rng_state, seed_everything, set_global_rng_state
from crptpro.training.agent import PixelAgent, save_agent
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.downstream_config import DownstreamConfig
from crptpro.training.downstream_parts import Parts, build_parts
from crptpro.training.evaluate import evaluate, summarize
from crptpro.training.video import write_video

logger = logging.getLogger(__name__)

EnvFactory = Callable[..., EnvBase]


@dataclass(frozen=True)
class DownstreamResult:
    """What a downstream run leaves.

    Attributes:
        policy: the trained agent, deterministic.
        evaluations: one row per evaluated episode: ``env_steps``, ``episode``, ``episode_return``, ...
        agent_path: artifact of the agent, ``None`` without a run directory.
        env_steps: simulator steps taken.
    """

    policy: PixelAgent
    evaluations: list[dict[str, Any]]
    agent_path: Path | None
    env_steps: int


def train_downstream(
    task: str,
    pretrained: Pretrained | str | Path,
    *,
    run_dir: str | Path | None = None,
    config: DownstreamConfig | None = None,
    logger: RunLogger | None = None,
    resume: bool = True,
    progress: bool = True,
    env_factory: EnvFactory = make_env,
    **overrides: Any,
) -> DownstreamResult:
    """Train SAC on a task with the encoder frozen.

    Args:
        task: any name that :func:`crptpro.envs.make_env` knows.
        pretrained: an artifact or its directory. Without prototypes there is no bonus, which is said once.
        run_dir: records, checkpoints and the agent go here; ``None`` keeps nothing but the result.
        config: every number; the paper's by default.
        logger: records and mirrors; by default a local record in ``run_dir``.
        resume: continue from the newest checkpoint in ``run_dir``. Checkpoints are taken between episodes, so a
            kill costs the episodes since the last one and, on a CPU, changes no number.
        progress: show bars (never in log files).
        env_factory: makes the environments; called as :func:`~crptpro.envs.make_env` is.
        **overrides: single settings of :class:`DownstreamConfig`, e.g. ``env_steps=100_000``.

    Returns:
        The agent and every evaluated episode.

    Raises:
        PretrainedError: if the artifact does not fit, e.g. another image size, or actor weights only.
        CheckpointError: if ``run_dir`` holds a run with other settings.
        NonFiniteError: if a loss became NaN or infinite; the last checkpoint is kept.
    """
    config = dataclasses.replace(config or DownstreamConfig(), **overrides)
    if not isinstance(pretrained, Pretrained):
        pretrained = load_pretrained(pretrained)
    if run_dir is None:
        with tempfile.TemporaryDirectory(prefix="crptpro-") as directory:
            run = _Run(task, pretrained, Path(directory), config, logger, progress, env_factory)
            result = run.finish(run.train(checkpoints=None))
            return dataclasses.replace(result, agent_path=None)
    run_dir = Path(run_dir)
    run = _Run(task, pretrained, run_dir, config, logger, progress, env_factory)
    checkpoints = CheckpointDir(run_dir / "checkpoints")
    if resume:
        run.resume(checkpoints)
    elif checkpoints.latest_counter() is not None:
        raise CheckpointError(f"{run_dir} already holds a run. Choose another directory, or resume it (resume=True).")
    return run.finish(run.train(checkpoints=checkpoints))


class _Run:
    """The state of one run: parts, counters, generators."""

    def __init__(
        self,
        task: str,
        pretrained: Pretrained,
        run_dir: Path,
        config: DownstreamConfig,
        records: RunLogger | None,
        progress: bool,
        env_factory: EnvFactory,
    ) -> None:
        self.task, self.config, self.run_dir, self.progress = task, config, run_dir, progress
        seed_everything(derive_seed(config.seed, "downstream"))
        settings = {"quality": config.quality, "action_repeat": config.action_repeat}
        card = pretrained.card
        settings |= {"image_size": card["image_size"], "frame_stack": card["frame_stack"]}
        self.env = env_factory(task, seed=config.seed, **settings)
        self.make_eval_env = lambda: env_factory(task, seed=config.seed, **settings)
        self.eval_env: EnvBase | None = None
        self.generators = {
            name: torch.Generator().manual_seed(derive_seed(config.seed, "downstream", name))
            for name in ("replay", "shift", "bonus", "policy", "random_actions")
        }
        self.parts: Parts = build_parts(pretrained, self.env, config, self.generators, run_dir)
        self.records = records or RunLogger(run_dir, config={"task": task, **dataclasses.asdict(config)})
        self.provenance = {"pretrained": pretrained.identity(), "feature_mode": self.parts.feature_mode}
        self.agent_steps = self.updates = self.episodes = self.evaluations = 0
        self.next_eval = self.next_checkpoint = 0
        self.sums: dict[str, Tensor] = {}
        self.summed_updates = 0

    @property
    def env_steps(self) -> int:
        return self.agent_steps * self.config.action_repeat

    # --- the loop -----------------------------------------------------------------------------------------------

    def train(self, checkpoints: CheckpointDir | None) -> None:
        """Alternate evaluations, checkpoints and episodes until the budget is spent."""
        config = self.config
        bar = tqdm(
            total=config.env_steps,
            initial=self.env_steps,
            desc=self.task,
            unit="env step",
            leave=False,
            disable=None if self.progress else True,
        )
        self.next_checkpoint = self.next_checkpoint or config.checkpoint_interval_env_steps
        try:
            while True:
                finished = self.env_steps >= config.env_steps
                if self.env_steps >= self.next_eval or (finished and self.next_eval != -1):
                    self.evaluate()
                    self.next_eval = -1 if finished else self._after(config.eval_interval_env_steps)
                    evaluated = True
                else:
                    evaluated = False
                if checkpoints is not None and (
                    self.env_steps >= self.next_checkpoint or (finished and evaluated)
                ):
                    self.next_checkpoint = self._after(config.checkpoint_interval_env_steps)
                    self.save(checkpoints)
                if finished:
                    return
                self.run_episode(bar)
        finally:
            bar.close()

    def _after(self, interval: int) -> int:
        return (self.env_steps // interval + 1) * interval

    def run_episode(self, bar: tqdm) -> None:
        """Act for one episode, or to the end of the budget, with one update per decision."""
        config, parts = self.config, self.parts
        self.env.set_seed(derive_seed(config.seed, "downstream", "episode", self.episodes))
        observation = self.env.reset()
        row = parts.replay.begin_episode(observation["pixels"][-3:])
        features = parts.features.observe(observation["pixels"], row)
        episode_return, agent_steps, done = 0.0, 0, False
        while not done and self.env_steps < config.env_steps:
            action = self.act(features)
            if self.agent_steps >= config.random_agent_steps:
                self.update()
            observation["action"] = action
            transition = self.env.step(observation)
            following = transition["next"]
            row = parts.replay.append(
                action,
                following["reward"],
                following["terminated"],
                following["truncated"],
                following["pixels"][-3:],
            )
            features = parts.features.observe(following["pixels"], row)
            episode_return += following["reward"].item()
            agent_steps += 1
            self.agent_steps += 1
            done = bool(following["done"].item())
            observation = step_mdp(transition)
            bar.update(config.action_repeat)
            if self.env_steps % config.log_interval_env_steps < config.action_repeat:
                self.log_training()
        self.episodes += 1
        row_of_log = {"episode_return": episode_return, "episode_agent_steps": agent_steps}
        self.records.log(row_of_log, stream="episodes", env_steps=self.env_steps, episodes=self.episodes)

    @torch.no_grad()
    def act(self, features: Tensor) -> Tensor:
        """Return the next action: uniform at first, then a sample of the policy."""
        if self.agent_steps < self.config.random_agent_steps:
            shape = self.env.action_spec.shape
            return torch.rand(shape, generator=self.generators["random_actions"]) * 2 - 1
        action, _ = self.parts.actor.sample(features, generator=self.generators["policy"])
        return action.squeeze(0).float().cpu().clamp(-1, 1)

    def update(self) -> None:
        """Sample, shift, encode, add the bonus, and let the learner step."""
        parts = self.parts
        batch: TensorDictBase = parts.features.sample(self.config.batch_size)
        if parts.bonus is not None:
            batch = parts.bonus(batch)
        metrics = parts.learner.update(batch, agent_step=self.agent_steps)
        if parts.bonus is not None:
            metrics["intrinsic_reward"] = batch["next", "intrinsic_reward"].mean()
        for key, value in metrics.items():
            self.sums[key] = self.sums.get(key, 0) + value.detach()
        self.summed_updates += 1
        self.updates += 1

    # --- records ------------------------------------------------------------------------------------------------

    def log_training(self) -> None:
        """Write the mean of every metric over the updates since the last row."""
        if self.summed_updates == 0:
            return
        delayed = {"loss_actor", "loss_alpha", "alpha", "entropy"}
        means = {}
        for key, total in self.sums.items():
            count = self.summed_updates
            if key in delayed:
                count = max(1, count // self.config.actor_update_interval)
            means[key] = (total / count).item()
            if means[key] != means[key] or means[key] in (float("inf"), float("-inf")):
                raise NonFiniteError(
                    f"{key} became {means[key]} before update {self.updates} of {self.task}. The last checkpoint is "
                    "kept; a smaller learning rate or precision='fp32' usually helps."
                )
        self.sums, self.summed_updates = {}, 0
        self.records.log(means, stream="train", env_steps=self.env_steps, updates=self.updates)

    def evaluate(self) -> None:
        """Run whole deterministic episodes in an environment of their own and record each."""
        config = self.config
        self.eval_env = self.eval_env or self.make_eval_env()
        episodes, videos = evaluate(
            self.agent(),
            self.eval_env,
            episodes=config.eval_episodes,
            seed=derive_seed(config.seed, "downstream", "evaluation", self.evaluations),
            record_episodes=config.video_episodes,
            progress=self.progress,
        )
        counters = {"env_steps": self.env_steps, "agent_steps": self.agent_steps, "updates": self.updates}
        for e in episodes:
            row = {"episode_return": e.episode_return, "episode_agent_steps": e.agent_steps, "seed": e.seed}
            self.records.log(row, stream="eval", episode=e.episode, **counters)
        for index, pictures in enumerate(videos):
            path = self.run_dir / "videos" / f"env_steps_{self.env_steps:08d}_episode_{index}.mp4"
            if write_video(pictures, path) is not None:
                self.records.video("eval/video", path, env_steps=self.env_steps)
        scores = summarize(episodes)
        self.records.event(
            f"{self.task}: {self.env_steps:,} env steps, {self.updates:,} updates, "
            f"return {scores['mean']:.1f} ± {scores['std']:.1f} over {len(episodes)} episodes"
        )
        self.evaluations += 1

    def agent(self) -> PixelAgent:
        """Return the policy as it is now."""
        return PixelAgent(self.parts.encoder, self.parts.actor)

    def finish(self, _: None) -> DownstreamResult:
        """Write the agent, close the environments and return the result."""
        card = {
            "task": self.task,
            "env_steps": self.env_steps,
            "config": dataclasses.asdict(self.config),
            **self.provenance,
        }
        agent_path = save_agent(self.run_dir / "agent", self.agent(), card=card)
        self.records.artifact(agent_path, name="agent", kind="agent")
        for env in (self.env, self.eval_env):
            if env is not None:
                env.close()
        return DownstreamResult(self.agent(), self.records.rows("eval"), agent_path, self.env_steps)

    # --- checkpoints --------------------------------------------------------------------------------------------

    COUNTERS = ("agent_steps", "updates", "episodes", "evaluations", "next_eval", "next_checkpoint")

    def fingerprint(self) -> dict[str, Any]:
        """Return everything that must agree for a checkpoint to be continued; budgets may grow."""
        settings = dataclasses.asdict(self.config)
        for free in ("env_steps", "device"):
            settings.pop(free)
        return {"task": self.task, **settings, "pretrained": self.provenance["pretrained"]}

    def save(self, checkpoints: CheckpointDir) -> None:
        """Write everything a resumed run needs; frames are already on disk, in the replay's own files."""
        self.log_training()
        state = {
            "fingerprint": self.fingerprint(),
            "counters": {name: getattr(self, name) for name in self.COUNTERS},
            "learner": self.parts.learner.state_dict(),
            "bonus": None if self.parts.bonus is None else self.parts.bonus.state_dict(),
            "replay": self.parts.replay.state_dict(),
            "generators": {name: generator.get_state() for name, generator in self.generators.items()},
            "global_rng": global_rng_state(),
            "records": self.records.state_dict(),
        }
        checkpoints.save(state, counter=self.agent_steps)

    def resume(self, checkpoints: CheckpointDir) -> None:
        """Continue from the newest checkpoint, if there is one."""
        state = checkpoints.load_latest()
        if state is None:
            return
        mine, theirs = self.fingerprint(), state["fingerprint"]
        differing = [name for name in mine if mine[name] != theirs.get(name)]
        if differing:
            name = differing[0]
            raise CheckpointError(
                f"{self.run_dir} holds a run with {name} = {theirs.get(name)!r}, not {mine[name]!r}. Use the same "
                "settings to continue it, or another directory."
            )
        for name, value in state["counters"].items():
            setattr(self, name, value)
        self.parts.learner.load_state_dict(state["learner"])
        if self.parts.bonus is not None:
            self.parts.bonus.load_state_dict(state["bonus"])
        self.parts.replay.load_state_dict(state["replay"])
        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name])
        set_global_rng_state(state["global_rng"])
        self.records.load_state_dict(state["records"])
        if self.next_eval == -1 and self.env_steps < self.config.env_steps:
            self.next_eval = self._after(self.config.eval_interval_env_steps)  # a finished run with a larger budget
        logger.info("%s: continuing from %s env steps", self.task, f"{self.env_steps:,}")
        self.parts.features.rebuild(progress=self.progress)

"""The downstream loop: act, store, update; between episodes evaluate and checkpoint."""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm.auto import tqdm

from crptpro.domains import get_domain
from crptpro.downstream_config import DownstreamConfig
from crptpro.envs import make_env
from crptpro.loggers import RunLogger
from crptpro.pretrained import Pretrained
from crptpro.seeding import derive_seed, seed_everything
from crptpro.training import downstream_checkpoint
from crptpro.training.agent import PixelAgent, save_agent
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.downstream_evaluation import DownstreamEvaluation
from crptpro.training.downstream_parts import Parts, build_parts
from crptpro.training.downstream_replay import SlackWatch
from crptpro.training.env_thread import EnvThread, runs_ahead
from crptpro.training.evaluation_pool import WORKER_BYTES
from crptpro.training.finite import not_finite, require_finite_parameters
from crptpro.training.stop_request import StopRequest

logger = logging.getLogger(__name__)

EnvFactory = Callable[..., EnvBase]


class DownstreamRun:
    """One run: what it is made of, where it stands, and how it goes on.

    Args:
        task: what to learn.
        pretrained: the encoder, and prototypes for the bonus.
        run_dir: replay, records, checkpoints and agent.
        config: every number.
        records: where metrics go.
        progress: show bars.
        env_factory: makes the environments.
        state: of the checkpoint that this run will continue from, if any.
    """

    def __init__(
        self,
        task: str,
        pretrained: Pretrained,
        run_dir: Path,
        config: DownstreamConfig,
        records: RunLogger,
        *,
        progress: bool,
        env_factory: EnvFactory,
        state: Mapping[str, Any] | None = None,
    ) -> None:
        self.task, self.config, self.run_dir, self.progress = task, config, run_dir, progress
        seed_everything(derive_seed(config.seed, "downstream"))
        encoder = pretrained.encoder
        settings: dict[str, Any] = {
            "quality": config.quality,
            "action_repeat": config.resolved_action_repeat,
            "image_size": encoder.image_size,
            "frame_stack": encoder.in_channels // 3,
            # A factory of one's own need not know of colours.
            **({"colors": config.colors} if config.colors != "normal" else {}),
        }
        # The domain itself, whose name may be registered in this process only.
        name = get_domain(task) if env_factory is make_env else task
        make_this_env = functools.partial(env_factory, name, seed=config.seed, **settings)
        self.env = EnvThread(make_this_env, is_ahead=runs_ahead(task, config))
        self.generators = {
            name: torch.Generator().manual_seed(derive_seed(config.seed, "downstream", name))
            for name in ("replay", "shift", "bonus", "policy", "random_actions")
        }
        self.records = records
        try:
            self.evaluation = DownstreamEvaluation(
                task,
                make_this_env,
                config,
                records,
                run_dir,
                method=config.algorithm if config.algorithm == "drq" else pretrained.label,
                progress=progress,
            )
            self.parts: Parts = build_parts(
                pretrained,
                task,
                self.env.env,
                config,
                self.generators,
                run_dir,
                reserved_bytes=self.evaluation.workers * WORKER_BYTES,
                state=state,
            )
        except BaseException:
            self.env.close()  # no run, nobody else to free the render context
            raise
        # What an encoder that is trained here began as tells nothing about the agent.
        self.pretrained_identity = None if self.parts.algorithm.trains_encoder else pretrained.identity()
        self.slack = SlackWatch(self.parts.replay)
        self.agent_steps = self.updates = self.episodes = 0
        self.last_eval = -1
        self.next_eval, self.next_checkpoint = 0, config.checkpoint_interval_env_steps
        self.sums: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}

    @property
    def env_steps(self) -> int:
        """Simulator steps taken so far."""
        return self.agent_steps * self.config.resolved_action_repeat

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
        with StopRequest("Stopping after this episode; press Ctrl-C again to stop at once.") as stop, bar:
            while True:
                is_finished = self.env_steps >= config.env_steps
                is_new = self.last_eval != self.env_steps
                if stop.signal is not None and not is_finished:
                    if checkpoints is not None:
                        self.save(checkpoints)
                    logger.warning(
                        "Stopped at %s of %s env steps.", f"{self.env_steps:,}", f"{config.env_steps:,}"
                    )
                    stop.leave()
                is_evaluated = is_new and (self.env_steps >= self.next_eval or is_finished)
                if is_evaluated:
                    self.evaluation.start(self.agent(), self.counters())
                    self.last_eval = self.env_steps
                    self.next_eval = self._after(config.eval_interval_env_steps)
                is_due = self.env_steps >= self.next_checkpoint
                if is_finished or (is_due and not is_evaluated):
                    # The rows of an evaluation appear at places that do not depend on how long it took.
                    is_due = self.evaluation.finish() or is_new or is_due
                if checkpoints is not None and is_due:
                    self.next_checkpoint = self._after(config.checkpoint_interval_env_steps)
                    self.save(checkpoints)
                if is_finished:
                    return
                self.run_episode(bar)

    def counters(self) -> dict[str, int]:
        """Where the run is."""
        return {"env_steps": self.env_steps, "agent_steps": self.agent_steps, "updates": self.updates}

    def _after(self, interval: int) -> int:
        return (self.env_steps // interval + 1) * interval

    def run_episode(self, bar: tqdm) -> None:
        """Act for one episode, or to the end of the budget, with one update per decision."""
        config, parts = self.config, self.parts
        observation = self.env.reset(derive_seed(config.seed, "downstream", "episode", self.episodes))
        slot = parts.replay.begin_episode(observation["pixels"][-3:])
        features = parts.features.observe(observation["pixels"], slot)
        episode_return, agent_steps, done = 0.0, 0, False
        while not done and self.env_steps < config.env_steps:
            action = self.act(features)
            observation["action"] = action
            # The action is chosen: the next picture can be drawn while the update computes.
            self.env.begin_step(observation)
            if self.agent_steps >= config.random_agent_steps and parts.is_due(self.agent_steps):
                self.update()
            transition = self.env.end_step()
            following = transition["next"]
            slot = parts.replay.append(
                action,
                following["reward"],
                following["terminated"],
                following["truncated"],
                following["pixels"][-3:],
            )
            self.slack.check()
            features = parts.features.observe(following["pixels"], slot)
            episode_return += following["reward"].item()
            agent_steps, self.agent_steps = agent_steps + 1, self.agent_steps + 1
            done = bool(following["done"].item())
            observation = step_mdp(transition)
            bar.update(config.resolved_action_repeat)
            if self.env_steps % config.log_interval_env_steps < config.resolved_action_repeat:
                self.log_training()
        self.episodes += 1
        row = {"episode_return": episode_return, "episode_agent_steps": agent_steps}
        self.records.log(row, stream="episodes", env_steps=self.env_steps, episodes=self.episodes)

    @torch.no_grad()
    def act(self, features: Tensor) -> Tensor:
        """Return the next action: uniform at first, then a sample of the policy.

        Raises:
            NonFiniteError: if the policy has diverged; no simulator should see that.
        """
        at_once = self.parts.algorithm.explores_at_once
        if self.agent_steps < self.config.random_agent_steps and not at_once:
            shape, generator = self.env.env.action_spec.shape, self.generators["random_actions"]
            return 2 * torch.rand(shape, generator=generator) - 1
        action = self.parts.algorithm.explore(features).squeeze(0).float().cpu().clamp(-1, 1)
        if not torch.isfinite(action).all():
            raise not_finite(f"After update {self.updates} the policy of {self.task} acts {action.tolist()}")
        return action

    def update(self) -> None:
        """Let the learner step on a batch, and keep its metrics for the next row."""
        metrics = self.parts.update(self.config.batch_size, agent_step=self.agent_steps)
        for key, value in metrics.items():
            self.sums[key] = self.sums.get(key, 0) + value.detach()
            self.counts[key] = self.counts.get(key, 0) + 1
        self.updates += 1

    # --- records ------------------------------------------------------------------------------------------------

    def log_training(self) -> None:
        """Write the mean of every metric over the updates since the last row."""
        if not self.sums:
            return
        self.check_finite()
        # Each by its own count: the actor's metrics come from the delayed updates only.
        means = {key: (total / self.counts[key]).item() for key, total in self.sums.items()}
        self.sums, self.counts = {}, {}
        self.records.log(means, stream="train", env_steps=self.env_steps, updates=self.updates)

    def check_finite(self) -> None:
        """Refuse to log or keep a run that has diverged.

        Raises:
            NonFiniteError: naming the metric; the last checkpoint is kept.
        """
        for key, total in self.sums.items():
            if not torch.isfinite(total):
                raise not_finite(f"Update {self.updates} or before: {key} of {self.task} is {total.item()}")

    def agent(self) -> PixelAgent:
        """Return the policy as it is now."""
        return self.parts.agent()

    def save_agent(self) -> Path:
        """Write the agent as it is now, with a card."""
        card = {
            "task": self.task,
            "env_steps": self.env_steps,
            "config": dataclasses.asdict(self.config),
            "pretrained": self.pretrained_identity,
            "feature_mode": self.parts.feature_mode,
        }
        path = save_agent(self.run_dir / "agent", self.agent(), card=card)
        self.records.artifact(path, name=f"agent_{self.task}", kind="agent")
        return path

    def close(self) -> None:
        """Free the render contexts and end the evaluating processes."""
        try:
            self.evaluation.close()
        finally:
            self.env.close()

    # --- checkpoints --------------------------------------------------------------------------------------------

    def save(self, checkpoints: CheckpointDir) -> None:
        """Write everything a resumed run needs, unless the run has diverged.

        Raises:
            NonFiniteError: naming a metric or a weight; earlier checkpoints are kept.
        """
        self.check_finite()
        require_finite_parameters(self.parts.learner.loss, self.updates)
        checkpoints.save(downstream_checkpoint.state_of(self), counter=self.agent_steps)
        self.slack.saved()

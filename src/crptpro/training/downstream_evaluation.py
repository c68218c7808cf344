"""A downstream run's evaluations: on schedule, on a snapshot of the agent, every episode recorded."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from crptpro.cards import cpu_cores
from crptpro.downstream_config import DownstreamConfig
from crptpro.envs import needs_gl
from crptpro.envs.rendering import backend_card, select_backend
from crptpro.errors import CRPTproError, RenderingError, UnknownNameError
from crptpro.loggers import RunLogger
from crptpro.seeding import derive_seed
from crptpro.training.agent import PixelAgent
from crptpro.training.evaluate import Episode, evaluate, summarize
from crptpro.training.evaluation_pool import EvaluationPool, Outcome, can_be_sent
from crptpro.training.video import write_video

logger = logging.getLogger(__name__)

WORTH_PROCESSES = 20
"""Episodes of a run from which on processes of their own pay: starting one takes as long as running an episode."""


class DownstreamEvaluation:
    """Evaluates the agent in processes of its own, or in this one, and writes the ``eval`` stream.

    In processes of its own an evaluation runs on a snapshot while training goes on. Its rows are written when the loop
    asks for them and not when they happen to be there: the record of a run is the same however fast its machine is.
    Where nobody asked for processes and they fail, this one takes over. Either way every decision is computed by one
    CPU thread (in this process, on the run's device), and a CPU run's numbers do not depend on which way it was.

    Args:
        task: for the announcements.
        make_env: builds an environment with seeds of its own.
        config: how many episodes, processes and videos.
        records: where rows, events and videos go.
        run_dir: videos go below it.
        method: whose evaluations these are, in every row.
        progress: show a bar.

    Attributes:
        workers: processes; 0 for none.
    """

    def __init__(
        self,
        task: str,
        make_env: Callable[[], EnvBase],
        config: DownstreamConfig,
        records: RunLogger,
        run_dir: Path,
        *,
        method: str,
        progress: bool,
    ) -> None:
        self.task, self.config, self.records, self.run_dir = task, config, records, run_dir
        self.method, self.progress = method, progress
        self._make_env = make_env
        self.workers = eval_workers(task, make_env, config)
        if self.workers:
            logger.info("evaluation: %d processes of its own, while training goes on", self.workers)
        self._pool = EvaluationPool(make_env, workers=self.workers) if self.workers else None
        self._env: EnvBase | None = None
        self._pending: tuple[PixelAgent, dict[str, int]] | None = None

    def start(self, agent: PixelAgent, counters: Mapping[str, int]) -> None:
        """Evaluate the agent as it is now; with processes of its own, return at once.

        Args:
            agent: what to evaluate.
            counters: where the run is: ``env_steps`` and others, written into every row.
        """
        self.finish()
        snapshot = agent.snapshot()
        self._pending = (snapshot, dict(counters))
        if self._pool is None:
            self.finish()
        else:
            self._pool.start(snapshot, **self._how(counters))

    def finish(self) -> bool:
        """Wait for the evaluation that is under way and record it; returns whether there was one.

        Raises:
            CRPTproError: if a process that was asked for fails.
        """
        if self._pending is None:
            return False
        agent, counters = self._pending
        outcome = self._from_pool()
        if outcome is None:
            self._env = self._env or self._make_env()
            with _one_thread():
                outcome = evaluate(agent, self._env, progress=self.progress, **self._how(counters))
        self._pending = None
        self._record(counters, *outcome)
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the evaluation that is under way; its rows are not in the record yet."""
        if self._pending is None:
            return {"pending": None}
        agent, counters = self._pending
        return {"pending": {"counters": counters, **agent.state_dict()}}

    def load_state_dict(self, state: Mapping[str, Any], agent: PixelAgent) -> None:
        """Start again what was under way.

        Args:
            state: from :meth:`state_dict`.
            agent: of the run; left as it is.
        """
        if state["pending"] is None:
            return
        then = agent.snapshot()
        then.load_state_dict(state["pending"])
        self.start(then, state["pending"]["counters"])

    def close(self) -> None:
        """Free the render context and end the processes. Harmless when called again."""
        try:
            if self._pool is not None:
                self._pool.close()
        finally:
            if self._env is not None:
                self._env.close()
                self._env = None

    def _how(self, counters: Mapping[str, int]) -> dict[str, int]:
        return {
            "episodes": self.config.eval_episodes,
            "seed": derive_seed(self.config.seed, "downstream", "evaluation", counters["env_steps"]),
            "record_episodes": self.config.video_episodes,
        }

    def _from_pool(self) -> Outcome | None:
        if self._pool is None:
            return None
        try:
            return self._pool.result()
        except CRPTproError as reason:
            if self.config.eval_workers is not None:
                raise
            logger.warning("%s Evaluating in the training process from here on.", reason)
            self._pool.close()
            self._pool = None
            return None

    def _record(self, counters: Mapping[str, int], episodes: list[Episode], videos: list[Tensor]) -> None:
        for e in episodes:
            row: dict[str, Any] = {"episode_return": e.episode_return, "episode_agent_steps": e.agent_steps}
            row |= {"seed": e.seed, "method": self.method}
            self.records.log(row, stream="eval", episode=e.episode, **counters)
        env_steps = counters["env_steps"]
        for index, pictures in enumerate(videos):
            path = self.run_dir / "videos" / f"env_steps_{env_steps:08d}_episode_{index}.mp4"
            if write_video(pictures, path) is not None:
                self.records.video("eval/video", path, env_steps=env_steps)
        scores = summarize(episodes)
        self.records.event(
            f"{self.task}: {env_steps:,} env steps, {counters['updates']:,} updates, "
            f"return {scores['mean']:.1f} ± {scores['std']:.1f} over {len(episodes)} episodes"
        )


def eval_workers(task: str, make_env: Callable[[], EnvBase], config: DownstreamConfig) -> int:
    """Return how many processes evaluate: as asked, or one per core where that works and pays; 0 is this process.

    A run that shares its machine says so by torch's number of threads: left to itself it takes no more processes.

    Args:
        task: what is evaluated.
        make_env: builds the environment.
        config: what was asked.

    Raises:
        CRPTproError: processes were asked for, and cannot build the environment.
        RenderingError: processes were asked for, and the GPU's driver does not render in so many at once.
    """
    asked = config.eval_workers
    own_cores = min(cpu_cores(), torch.get_num_threads())
    workers = min(own_cores if asked is None else asked, config.eval_episodes)
    evaluations = -(-config.env_steps // config.eval_interval_env_steps) + 1
    pays = cpu_cores() > 1 and evaluations * config.eval_episodes >= WORTH_PROCESSES
    if asked == 0 or (asked is None and not pays):
        return 0
    if not can_be_sent(make_env):
        if asked is not None:
            raise CRPTproError(
                f"eval_workers is {asked}, but the environment of {task} cannot be built in another process: its "
                "factory must be a function of an importable module. Move it there, or set eval_workers=0."
            )
        return 0
    try:
        _prove_rendering(task, workers)
    except RenderingError as reason:
        if asked is not None:
            raise
        logger.warning("%s Evaluating in the training process instead.", reason)
        return 0
    return workers


def _prove_rendering(task: str, workers: int) -> None:
    """Some GPU drivers hang when several processes render; software does not."""
    with suppress(UnknownNameError):  # only a caller's own factory knows the task
        if needs_gl(task) and (card := backend_card())["gl_kind"] == "hardware":
            # With this very backend: the training environment has it.
            select_backend(card["backend"], processes=workers + 1)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute with one thread, as the evaluating processes do: sums of another order may round another way."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

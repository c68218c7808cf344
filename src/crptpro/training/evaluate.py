"""Deterministic evaluation of whole episodes, each from its own seed, during training or on its own."""

from __future__ import annotations

import copy
import logging
import math
import pickle
import statistics
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from torchrl.modules import RandomPolicy
from tqdm.auto import tqdm

from crptpro.errors import NonFiniteError
from crptpro.seeding import derive_seed
from crptpro.training.agent import PixelAgent
from crptpro.values import as_int
from crptpro.workers import WorkerPool, can_be_sent

logger = logging.getLogger(__name__)

Policy = Callable[[Any], Any]
"""Maps one observation, uint8 ``[C, H, W]``, to one action, float32 ``[A]`` in ``[-1, 1]``; or a TorchRL policy."""
WORKER_BYTES = 500_000_000


@dataclass(frozen=True)
class Episode:
    """One evaluated episode."""

    episode: int
    """index within the evaluation, from 0"""
    episode_return: float
    """sum of the environment's own rewards, without any bonus"""
    agent_steps: int
    """``env_steps / action_repeat``"""
    seed: int
    """of the environment, set before its reset"""


def evaluate(
    policy: Policy,
    env: EnvBase,
    *,
    episodes: int = 10,
    seed: int = 0,
    progress: bool = True,
    on_episode: Callable[[Episode], Any] = lambda episode: None,
) -> list[Episode]:
    """Run a policy for whole episodes and return one result per episode.

    Every episode has its own seed, so that neither earlier evaluations nor the number of processes change a result.
    The environment is unbatched, with ``pixels`` uint8 ``[C, H, W]`` and without an intrinsic reward. TorchRL
    distributions act with ``ExplorationType.DETERMINISTIC``; put a policy with dropout in evaluation mode first.
    ``on_episode`` is called with each episode as it ends.

    Raises:
        ValueError: fewer than one episode.
        NonFiniteError: an action or a reward is NaN or infinite; names the episode.
    """
    results: list[Episode] = []
    bar = tqdm(
        range(as_int(episodes, "episodes", minimum=1)), desc="evaluate", unit="episode", leave=False,
        disable=None if progress else True,
    )  # fmt: skip
    for index in bar:
        results.append(run_episode(policy, env, episode=index, seed=episode_seed(seed, index)))
        on_episode(results[-1])
        bar.set_postfix(mean_return=f"{statistics.fmean(e.episode_return for e in results):.1f}")
    return results


def run_episode(
    policy: Policy, env: EnvBase, *, episode: int, seed: int, on_frame: Callable[[Tensor], Any] | None = None
) -> Episode:
    """Run one episode of :func:`evaluate`; ``on_frame`` is called with every RGB image, uint8 ``[3, H, W]``."""
    env.set_seed(seed)
    td = env.reset()
    episode_return, agent_steps, done = 0.0, 0, False
    while not done:
        if on_frame is not None:
            on_frame(td["pixels"][-3:].clone())
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            if isinstance(policy, (TensorDictModuleBase, RandomPolicy)):
                with torch.no_grad():
                    td = td.update(policy(td.copy()))  # further entries are kept, e.g. a recurrent state
                action = td.get("action", None)
            else:
                action = policy(td["pixels"])
        if not isinstance(action, Tensor) or action.shape != env.action_spec.shape:
            got = tuple(action.shape) if isinstance(action, Tensor) else type(action).__name__
            raise ValueError(
                f"Evaluation episode {episode}, agent step {agent_steps}: the policy returned {got} for an action of "
                f"shape {tuple(env.action_spec.shape)}. A policy maps pixels to one action, or is a TorchRL module "
                'that writes "action" into a TensorDict.'
            )
        td["action"] = action.detach()
        transition = env.step(td)
        episode_return += transition["next", "reward"].item()
        agent_steps += 1
        done = bool(transition["next", "done"].item())
        td = step_mdp(transition)
    if not math.isfinite(episode_return):  # make_env's environments check every action and reward themselves
        raise NonFiniteError(f"Evaluation episode {episode}: the rewards sum to {episode_return}.")
    return Episode(episode, episode_return, agent_steps, seed)


def episode_seed(seed: int, episode: int) -> int:
    """Return the seed of the environment in an episode of an evaluation."""
    return derive_seed(seed, "episode", episode)


def uniform_policy(env: EnvBase, *, seed: int) -> Policy:
    """Return the uniform random policy on ``[-1, 1]^A``, the control that every result is read against."""
    generator = torch.Generator().manual_seed(derive_seed(seed, "uniform_policy"))
    action_dim = env.action_spec.shape[-1]
    return lambda pixels: torch.rand(action_dim, generator=generator, device="cpu") * 2 - 1


def summarize(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return ``mean``, ``std`` (unbiased; 0 for one episode), ``min`` and ``max`` of the returns."""
    returns = [episode.episode_return for episode in episodes]
    spread = statistics.stdev(returns) if len(returns) > 1 else 0.0
    return {"mean": statistics.fmean(returns), "std": spread, "min": min(returns), "max": max(returns)}


class Evaluator:
    """Evaluates snapshots of an agent in worker processes during training, or at once in this process.

    ``on_result`` gets the episodes and the counters of an evaluation, called by :meth:`poll` once it has ended, or by
    :meth:`finish`. Without ``workers``, or where none can import ``make_env`` or the encoder's class, this process
    evaluates. One CPU thread computes every action either way.
    """

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        agent: PixelAgent,
        *,
        episodes: int,
        seed: int,
        workers: int,
        on_result: Callable[[list[Episode], Mapping[str, int]], None],
        progress: bool = True,
    ) -> None:
        self.make_env, self.agent, self.episodes, self.seed = make_env, agent, episodes, seed
        is_sent = can_be_sent(make_env) and can_be_sent(agent)
        self.workers = min(workers, episodes) if is_sent else 0
        if workers and not is_sent:
            logger.info("Evaluating in this process: no other one can import the environment or the encoder.")
        self.on_result, self.progress = on_result, progress
        self._pool: WorkerPool | None = None
        self._env: EnvBase | None = None
        self._pending: tuple[PixelAgent, dict[str, int], int, list[Future[Episode]]] | None = None

    def start(self, **counters: int) -> None:
        """Evaluate the run's current agent; ``counters``, with ``env_steps``, say how far the run is."""
        self.finish()
        self._begin(self.agent.snapshot(), counters)
        if not self.workers:
            self.finish()

    def _begin(self, agent: PixelAgent, counters: dict[str, int]) -> None:
        seed = derive_seed(self.seed, "evaluation", counters["env_steps"])
        futures: list[Future[Episode]] = []
        if self.workers:
            self._pool = self._pool or WorkerPool(self.workers, _prepare, self.make_env)
            sent = pickle.dumps(copy.deepcopy(agent).cpu())
            seeds = [episode_seed(seed, episode) for episode in range(self.episodes)]
            try:
                futures = [self._pool.submit(_evaluate, sent, *numbered) for numbered in enumerate(seeds)]
            except (BrokenProcessPool, OSError) as reason:  # died since the last evaluation, or cannot be started
                self._give_up(reason)
        self._pending = (agent, counters, seed, futures)

    def poll(self) -> None:
        """Deliver the pending evaluation if it has ended."""
        if self._pending is not None and all(future.done() for future in self._pending[-1]):
            self.finish()

    def finish(self) -> None:
        """Wait for the pending evaluation, if any, and deliver its episodes."""
        if self._pending is None:
            return
        agent, counters, seed, futures = self._pending
        try:
            episodes = [future.result() for future in futures]
        except BrokenProcessPool as reason:
            self._give_up(reason)
            futures = []
        if not futures:
            self._env = self._env or self.make_env()
            threads = torch.get_num_threads()
            torch.set_num_threads(1)  # as in the workers: another order of summation may round differently
            try:
                agent = copy.deepcopy(agent).cpu()  # a GPU may round differently from the workers
                episodes = evaluate(agent, self._env, episodes=self.episodes, seed=seed, progress=self.progress)
            finally:
                torch.set_num_threads(threads)
        self._pending = None
        self.on_result(episodes, counters)

    def _give_up(self, reason: Exception) -> None:
        logger.warning("The evaluating processes are lost (%s); evaluating in this process from here on.", reason)
        self.workers = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the pending evaluation, whose episodes are not in the record yet."""
        if self._pending is None:
            return {}
        agent, counters, *_ = self._pending
        return {"counters": counters, "agent": agent.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state:
            agent = copy.deepcopy(self.agent)
            agent.load_state_dict(state["agent"])
            self._begin(agent, state["counters"])  # delivered later, when the record is restored

    def close(self) -> None:
        if self._pool is not None:
            self._pool.end()
        if self._env is not None:
            self._env.close()


# --- in a worker ------------------------------------------------------------------------------------------------------

_env: EnvBase


def _prepare(make_env: Callable[[], EnvBase]) -> None:
    global _env
    _env = make_env()


def _evaluate(agent: bytes, episode: int, seed: int) -> Episode:
    return run_episode(pickle.loads(agent), _env, episode=episode, seed=seed)

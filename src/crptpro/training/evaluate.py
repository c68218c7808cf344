"""Deterministic evaluation: whole episodes, each from its own seed, beside training or between it."""

from __future__ import annotations

import copy
import logging
import math
import multiprocessing
import os
import pickle
import signal
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm.auto import tqdm

from crptpro.errors import NonFiniteError
from crptpro.plugins import load_again, loaded_plugins
from crptpro.seeding import derive_seed
from crptpro.training.agent import PixelAgent
from crptpro.values import as_int

logger = logging.getLogger(__name__)

Policy = Callable[[Tensor], Tensor]
"""Maps one observation, uint8 ``[C, H, W]``, to one action, float32 ``[A]`` in ``[-1, 1]``."""
WORKER_BYTES = 500_000_000


@dataclass(frozen=True)
class Episode:
    """One evaluated episode.

    Attributes:
        episode: index within the evaluation, from 0.
        episode_return: sum of the environment's own rewards, without any bonus.
        agent_steps: decisions, ``env_steps / action_repeat``.
        seed: what the environment was seeded with before its reset.
    """

    episode: int
    episode_return: float
    agent_steps: int
    seed: int


def evaluate(
    policy: Policy, env: EnvBase, *, episodes: int = 10, seed: int = 0, progress: bool = True
) -> list[Episode]:
    """Run ``policy`` for whole episodes and return every episode's own return.

    The environment must carry no intrinsic reward. Every episode has a seed of its own, so that an evaluation is the
    same whatever was evaluated before, and in however many processes.

    Args:
        policy: maps one observation to one action.
        env: unbatched environment with ``pixels`` uint8 ``[C, H, W]``.
        episodes: how many, at least 1.
        seed: of this evaluation.
        progress: show a bar that vanishes when done.

    Raises:
        ValueError: fewer than one episode.
        NonFiniteError: the policy acts with NaN or infinity; names the episode.
    """
    episodes = as_int(episodes, "episodes", minimum=1)
    results: list[Episode] = []
    bar = tqdm(
        range(episodes), desc="evaluate", unit="episode", leave=False, disable=None if progress else True
    )
    for index in bar:
        results.append(run_episode(policy, env, episode=index, seed=episode_seed(seed, index)))
        bar.set_postfix(mean_return=f"{statistics.fmean(e.episode_return for e in results):.1f}")
    return results


def run_episode(
    policy: Policy, env: EnvBase, *, episode: int, seed: int, on_frame: Callable[[Tensor], Any] | None = None
) -> Episode:
    """Run ``policy`` for one episode.

    Args:
        policy: maps one observation to one action.
        env: unbatched environment.
        episode: index within the evaluation.
        seed: what the environment is seeded with before its reset.
        on_frame: called with every RGB picture, uint8 ``[3, H, W]``.
    """
    env.set_seed(seed)
    td = env.reset()
    episode_return, agent_steps, done = 0.0, 0, False
    while not done:
        if on_frame is not None:
            on_frame(td["pixels"][-3:].clone())
        td["action"] = action = policy(td["pixels"])
        if not torch.isfinite(action).all():
            raise NonFiniteError(
                f"Evaluation episode {episode}, decision {agent_steps}: the policy acts {action.tolist()}."
            )
        transition = env.step(td)
        reward = transition["next", "reward"].item()
        if not math.isfinite(reward):
            raise NonFiniteError(
                f"Evaluation episode {episode}, decision {agent_steps}: the reward is {reward}."
            )
        episode_return, agent_steps = episode_return + reward, agent_steps + 1
        done = bool(transition["next", "done"].item())
        td = step_mdp(transition)
    return Episode(episode, episode_return, agent_steps, seed)


def episode_seed(seed: int, episode: int) -> int:
    """Return what the environment of an evaluation's episode is seeded with."""
    return derive_seed(seed, "episode", episode)


def uniform_policy(env: EnvBase, *, seed: int) -> Policy:
    """Return the uniform random policy on ``[-1, 1]^A``, the control that every result is read against."""
    generator = torch.Generator().manual_seed(derive_seed(seed, "uniform_policy"))
    action_dim = env.action_spec.shape[-1]
    return lambda pixels: torch.rand(action_dim, generator=generator) * 2 - 1


def summarize(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return ``mean``, ``std`` (unbiased; 0 for one episode), ``min`` and ``max`` of the returns."""
    returns = [episode.episode_return for episode in episodes]
    spread = statistics.stdev(returns) if len(returns) > 1 else 0.0
    return {"mean": statistics.fmean(returns), "std": spread, "min": min(returns), "max": max(returns)}


class Evaluator:
    """Evaluates snapshots of an agent in processes of its own while training goes on, or at once in this one.

    Rows are handed out when :meth:`finish` is called and not when they happen to be there, so that the record of a run
    does not depend on the speed of its machine. Every decision is computed by one CPU thread either way.

    Args:
        make_env: builds the environment.
        episodes: of every evaluation.
        seed: of the run.
        workers: processes; 0 evaluates in this process.
        on_result: called with the episodes and the counters of an evaluation.
        progress: show a bar where this process evaluates.
    """

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        *,
        episodes: int,
        seed: int,
        workers: int,
        on_result: Callable[[list[Episode], Mapping[str, int]], None],
        progress: bool = True,
    ) -> None:
        self.make_env, self.episodes, self.seed, self.on_result = make_env, episodes, seed, on_result
        self.workers, self.progress = min(workers, episodes) if can_be_sent(make_env) else 0, progress
        self._pool: ProcessPoolExecutor | None = None
        self._env: EnvBase | None = None
        self._pending: tuple[PixelAgent, dict[str, int], list[Future[Episode]]] | None = None

    def start(self, agent: PixelAgent, **counters: int) -> None:
        """Evaluate the agent as it is now; with processes of its own, return at once.

        Args:
            agent: what to evaluate.
            **counters: where the run is; ``env_steps`` among them.
        """
        self.finish()
        snapshot = agent.snapshot()
        futures: list[Future[Episode]] = []
        if self.workers:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(
                    self.workers,
                    mp_context=multiprocessing.get_context("spawn"),
                    initializer=_start_worker,
                    initargs=(os.getpid(), loaded_plugins(), self.make_env),
                )
            sent = pickle.dumps(PixelAgent(copy.deepcopy(snapshot.encoder).cpu(), snapshot.actor.cpu()))
            seed = self._seed(counters)
            futures = [
                self._pool.submit(_run_episode, sent, episode, episode_seed(seed, episode))
                for episode in range(self.episodes)
            ]
        self._pending = (snapshot, dict(counters), futures)
        if not self.workers:
            self.finish()

    def finish(self) -> None:
        """Wait for the evaluation that is under way, if any, and hand out its episodes.

        Raises:
            CRPTproError: an episode failed in a worker as it would here.
        """
        if self._pending is None:
            return
        agent, counters, futures = self._pending
        try:
            episodes = [future.result() for future in futures]
        except (BrokenProcessPool, pickle.PicklingError, OSError) as reason:
            logger.warning(
                "The evaluating processes are lost (%s); evaluating in this process from here on.", reason
            )
            self.workers, futures = 0, []
            self._end_pool()
        if not futures:
            self._env = self._env or self.make_env()
            with _one_thread():
                episodes = evaluate(
                    agent,
                    self._env,
                    episodes=self.episodes,
                    seed=self._seed(counters),
                    progress=self.progress,
                )
        self._pending = None
        self.on_result(episodes, counters)

    def state_dict(self) -> dict[str, Any]:
        """Return the evaluation that is under way: its episodes are not in the record yet."""
        if self._pending is None:
            return {}
        agent, counters, _ = self._pending
        trained = any(parameter.requires_grad for parameter in agent.encoder.parameters())
        encoder = {"encoder": agent.encoder.state_dict()} if trained else {}
        return {"counters": counters, "actor": agent.actor.state_dict(), **encoder}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Start again what was under way; :attr:`agent` must be set to the run's agent before."""
        if not state:
            return
        agent = PixelAgent(copy.deepcopy(self.agent.encoder), copy.deepcopy(self.agent.actor))
        agent.actor.load_state_dict(state["actor"])
        if "encoder" in state:
            agent.encoder.load_state_dict(state["encoder"])
        self.start(agent, **state["counters"])

    agent: PixelAgent

    def close(self) -> None:
        """End the processes and free the render context."""
        self._end_pool()
        if self._env is not None:
            self._env.close()
            self._env = None

    def _seed(self, counters: Mapping[str, int]) -> int:
        return derive_seed(self.seed, "evaluation", counters["env_steps"])

    def _end_pool(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None


def can_be_sent(make_env: Callable[[], EnvBase]) -> bool:
    """Whether a worker can rebuild a factory: it pickles, and needs nothing of the main program."""
    try:
        return b"__main__" not in pickle.dumps(make_env)
    except Exception:  # objects may refuse in ways of their own
        return False


# --- in a worker ------------------------------------------------------------------------------------------------------

_make_env: Callable[[], EnvBase]
_env: EnvBase | None = None


def _start_worker(parent: int, plugins: tuple[str, ...], make_env: Callable[[], EnvBase]) -> None:
    global _make_env
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    threading.Thread(target=_exit_with, args=(parent,), daemon=True).start()
    load_again(plugins)
    _make_env = make_env


def _exit_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _run_episode(agent: bytes, episode: int, seed: int) -> Episode:
    global _env
    _env = _env or _make_env()
    return run_episode(pickle.loads(agent), _env, episode=episode, seed=seed)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute with one thread, as the workers do: sums of another order may round another way."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

"""What runs in a collecting process: a TorchRL collector that rolls out one planned episode at a time."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import RandomPolicy

from crptpro.data.episode import Episode
from crptpro.errors import error_name
from crptpro.plugins import load_again

HEARTBEAT_S = 1.0
POLLING = 25


@dataclass(frozen=True)
class EpisodeJob:
    """One episode to collect; its two seeds determine it wholly, whichever process runs it.

    Args:
        domain: Key of the environment factory.
        episode: Index in the dataset.
        env_seed: Seed of the simulator.
        action_seed: Seed of the uniform random policy.
        limit: Transitions after which no more are needed.
    """

    domain: str
    episode: int
    env_seed: int
    action_seed: int
    limit: int


class PlannedEpisodes(TransformedEnv):
    """An environment that runs exactly the episodes that :meth:`plan` announces, one per reset.

    TorchRL's collector resets an environment as soon as an episode ends, before anyone can say which episode
    comes next, and may go on stepping until its batch is full. Both are answered with zeros here, without
    touching the simulator: nothing is rendered in vain, and an episode depends on nothing that ran before it.
    """

    def __init__(self, env: EnvBase):
        super().__init__(env, auto_unwrap=False)
        self._job: EpisodeJob | None = None
        self._on_step: Callable[[int], bool] = lambda count: True
        self._limit, self._count, self._is_running = 0, 0, False
        self.was_cut = False
        blank = self.full_observation_spec.zero().update(self.full_done_spec.zero())
        self._blank_reset, self._blank_step = blank, blank.clone().update(self.full_reward_spec.zero())

    def plan(self, job: EpisodeJob, on_step: Callable[[int], bool]) -> None:
        """Announce the episode of the next reset.

        Args:
            job: The episode.
            on_step: Is told the number of transitions after each one; False ends the episode.
        """
        self._job, self._on_step = job, on_step

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        job, self._job = self._job, None
        if job is None:
            self._is_running = False
            return self._blank_reset.clone()
        self._limit, self._count, self._is_running, self.was_cut = job.limit, 0, True, False
        self.base_env.set_seed(job.env_seed)
        outcome = super()._reset(tensordict, **kwargs)
        # RandomPolicy draws from torch's global generator, which nothing else uses during the episode.
        torch.manual_seed(job.action_seed)
        return outcome

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._is_running:
            return self._blank_step.clone()
        outcome = super()._step(tensordict)
        self._count += 1
        goes_on = self._on_step(self._count) and self._count < self._limit
        if not goes_on and not outcome.get("done").any():
            self.was_cut = True
            outcome.set("truncated", torch.ones_like(outcome.get("truncated")))
            outcome.set("done", torch.ones_like(outcome.get("done")))
        return outcome


class EpisodeRoller:
    """Rolls out whole episodes of one domain with TorchRL's ``Collector`` and ``RandomPolicy``.

    ``trajs_per_batch=1`` makes the collector hand over exactly one whole episode, of any length. It looks for
    the end after every ``POLLING`` transitions; the steps it takes beyond the end never reach the simulator.

    Args:
        factory: Builds the environment, single frames per observation.
    """

    def __init__(self, factory: Callable[[], EnvBase]):
        env = factory()
        self.card: dict[str, Any] = env.card() if hasattr(env, "card") else {}
        self._env = PlannedEpisodes(env)
        self._collector = Collector(
            self._env,
            RandomPolicy(self._env.full_action_spec),
            frames_per_batch=POLLING,
            total_frames=-1,
            trajs_per_batch=1,
            traj_format="cat",
        )
        self._episodes = iter(self._collector)

    def roll(self, job: EpisodeJob, on_step: Callable[[int], bool] = lambda count: True) -> Episode:
        """Return the episode that ``job`` describes."""
        self._env.plan(job, on_step)
        self._collector.reset()
        return episode_from_rollout(next(self._episodes), is_cut=self._env.was_cut)

    def close(self) -> None:
        """Close the environment and free its render context."""
        self._collector.shutdown()


def episode_from_rollout(rollout: TensorDictBase, *, is_cut: bool = False) -> Episode:
    """Turn a TorchRL rollout ``[T]`` of single frames into an :class:`Episode` of T + 1 frames.

    Args:
        rollout: With ``pixels``, ``action``, ``("next", ...)`` and, if the world has them, ``qpos`` and
            ``qvel``.
        is_cut: The environment did not end the episode itself.
    """

    def per_frame(key: str) -> np.ndarray:
        last = rollout.get(("next", key))[-1:]
        return torch.cat([rollout.get(key), last]).numpy()

    def per_transition(key: str) -> np.ndarray:
        return rollout.get(("next", key)).reshape(len(rollout)).numpy()

    state_names = [name for name in ("qpos", "qvel") if name in rollout and rollout.get(name).shape[-1]]
    return Episode(
        pixels=per_frame("pixels"),
        action=rollout.get("action").numpy(),
        reward=per_transition("reward"),
        terminated=per_transition("terminated"),
        truncated=per_transition("truncated"),
        state={name: per_frame(name) for name in state_names},
        is_cut=is_cut,
    )


def worker_main(
    connection: Connection, factories: dict[str, Callable[[], EnvBase]], plugins: tuple[str, ...] = ()
) -> None:
    """Serve jobs until told to stop. Messages back: (kind, domain, payload), see ``WorkerPool``.

    Args:
        connection: to the parent.
        factories: of environments, by domain.
        plugins: that the parent has loaded: what they register in other libraries, a world of Gymnasium's say, has no
            name in this process yet.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C ends
    # One software-rendering thread per process is faster than several; it must be set before GL loads.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    roller: EpisodeRoller | None = None
    domain = ""
    try:
        load_again(plugins)
        while (job := connection.recv()) is not None:
            if not isinstance(job, EpisodeJob):
                continue  # a cancellation that arrived after its episode had ended
            if job.domain != domain:
                if roller is not None:
                    roller.close()
                roller, domain = EpisodeRoller(factories[job.domain]), job.domain
                connection.send(("environment", domain, roller.card))
            assert roller is not None
            episode = roller.roll(job, _Heartbeat(connection, job))
            connection.send(("episode", domain, (job.episode, episode)))
        if roller is not None:
            roller.close()
    except (BrokenPipeError, ConnectionResetError, EOFError):
        pass  # the parent is gone and needs no answer
    except Exception as reason:
        connection.send(("error", domain, (error_name(reason), str(reason), traceback.format_exc())))


class _Heartbeat:
    """Tells the parent about once a second how far an episode is; False if the parent no longer wants it."""

    def __init__(self, connection: Connection, job: EpisodeJob):
        self._connection, self._job = connection, job
        self._last = time.monotonic()
        self._goes_on = True

    def __call__(self, count: int) -> bool:
        now = time.monotonic()
        if now - self._last >= HEARTBEAT_S:
            self._last = now
            self._connection.send(("progress", self._job.domain, (self._job.episode, count)))
            if self._connection.poll():
                self._connection.recv()
                self._goes_on = False
        return self._goes_on


def _exit_with_parent() -> None:
    """End this process when its parent has ended, however it ended: nobody wants the episode any more."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)

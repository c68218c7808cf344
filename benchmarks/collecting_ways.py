"""The ways to collect pixels that ``benchmarks.collection`` compares: TorchRL's as documented, and ours.

TorchRL's environments render at every env step, so twice per agent step at an action repeat of 2, with a camera made
anew for every image. They leave images ``[H, W, C]`` and numbers float64.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, ReplayBuffer
from torchrl.envs import DMControlEnv, DMControlWrapper, EnvBase
from torchrl.modules import RandomPolicy

from crptpro.data import EpisodeWriter
from crptpro.data.collect_worker import EpisodeJob, EpisodeRoller
from crptpro.domains import SUITE_TASKS, Domain, get_domain
from crptpro.envs.rendering import select_backend
from crptpro.errors import CRPTproError


def stepper(env: EnvBase, transitions: int) -> Callable[[], None]:
    """Return a call that steps an environment at random so many times, resetting it where an episode ends."""
    policy = RandomPolicy(env.full_action_spec)
    state = env.reset()

    def step() -> None:
        nonlocal state
        for _ in range(transitions):
            _, state = env.step_and_maybe_reset(policy(state))

    return step


def stock_env(domain: str, *, image_size: int, action_repeat: int) -> EnvBase:
    """Build TorchRL's environment at the image size and camera that this library uses.

    ``DMControlEnv`` hands ``render_kwargs`` on to dm_control's task, which refuses it, so the size is given to the
    wrapper below it, ``DMControlWrapper``; they are the same environment otherwise.

    Raises:
        CRPTproError: for a domain that is not of dm_control's suite.
    """
    found, world, task = _suite_task(domain)
    from dm_control import suite  # after the choice of the render backend, which it reads

    return DMControlWrapper(
        suite.load(world, task, task_kwargs={"random": 0}),
        from_pixels=True,
        pixels_only=True,
        frame_skip=action_repeat,
        camera_id=found.camera,
        render_kwargs={"height": image_size, "width": image_size},
    )


def documented_env(domain: str, *, action_repeat: int) -> EnvBase:
    """Build ``DMControlEnv(domain, task, from_pixels=True, ...)``: 240 x 320 pixels, not to be changed.

    Raises:
        CRPTproError: for a domain that is not of dm_control's suite.
    """
    found, world, task = _suite_task(domain)
    return DMControlEnv(
        world, task, from_pixels=True, pixels_only=True, frame_skip=action_repeat, camera_id=found.camera
    )


class StockCollection:
    """``Collector`` filling a memory-mapped replay buffer with single frames.

    ``compact_obs`` stores each frame once (and no last frame of an episode, which this library keeps). The pages
    are left to the system to write; nothing waits for the disk.

    Args:
        env: owned by the collector from now on.
        transitions: of one call of :meth:`collect`.
        scratch: empty directory of the buffer's files.
        capacity: transitions that the buffer holds.
    """

    def __init__(self, env: EnvBase, *, transitions: int, scratch: Path, capacity: int) -> None:
        self.buffer = ReplayBuffer(storage=LazyMemmapStorage(capacity, scratch_dir=scratch))
        self._collector = Collector(
            env,
            RandomPolicy(env.full_action_spec),
            frames_per_batch=transitions,
            total_frames=-1,
            replay_buffer=self.buffer,
            compact_obs=True,
        )
        self._batches = iter(self._collector)

    def collect(self) -> None:
        """Add so many transitions to the buffer."""
        next(self._batches)

    def close(self) -> None:
        """Free the render context."""
        self._collector.shutdown()


class OwnCollection:
    """What a worker of ``collect_random`` and its parent do, in one process.

    Args:
        env: builds the environment.
        transitions: of one episode.
        root: empty directory of the dataset.
    """

    def __init__(self, env: Callable[[], EnvBase], *, transitions: int, root: Path) -> None:
        self._roller = EpisodeRoller(env)
        self._transitions, self._root = transitions, root
        self._writer: EpisodeWriter | None = None

    def collect(self) -> None:
        """Add an episode to the dataset."""
        index = self._writer.episodes if self._writer else 0
        job = EpisodeJob("domain", index, env_seed=index, action_seed=index, limit=self._transitions)
        episode = self._roller.roll(job)
        self._writer = self._writer or EpisodeWriter(self._root, episode.layout)
        self._writer.append(episode)

    def close(self) -> None:
        """Free the render context and close the files."""
        self._roller.close()
        if self._writer:
            self._writer.close()


def _suite_task(domain: str) -> tuple[Domain, str, str]:
    """Return a domain and the two names that dm_control has for its task; the render backend is chosen by then."""
    found = get_domain(domain)
    world = next((world for world, tasks in SUITE_TASKS.items() if found.task in tasks), None)
    if found.source != "suite" or world is None:
        raise CRPTproError(
            f"TorchRL's DMControlEnv knows dm_control's suite only, and {domain!r} is not of it."
        )
    select_backend()
    return found, world, found.task.removeprefix(f"{world}_")

"""Deterministic evaluation: whole episodes, each from its own seed, returned one by one."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm.auto import tqdm

from crptpro.seeding import derive_seed

Policy = Callable[[Tensor], Tensor]
"""Maps one observation, uint8 ``[C, H, W]``, to one action, float32 ``[A]`` in ``[-1, 1]``."""


@dataclass(frozen=True)
class Episode:
    """One evaluated episode.

    Attributes:
        episode: index within the evaluation, from 0.
        episode_return: sum of the environment's own rewards, without any bonus.
        agent_steps: decisions taken, ``env_steps / action_repeat``.
        seed: what the environment was seeded with before its reset.
    """

    episode: int
    episode_return: float
    agent_steps: int
    seed: int


def evaluate(
    policy: Policy,
    env: EnvBase,
    *,
    episodes: int = 10,
    seed: int = 0,
    record_episodes: int = 0,
    progress: bool = True,
) -> tuple[list[Episode], list[Tensor]]:
    """Run ``policy`` for whole episodes and return every episode's own return.

    The environment must carry no intrinsic reward. Episode ``e`` is seeded with
    ``episode_seed(seed, e)``, so an evaluation is the same whatever was evaluated before.

    Args:
        policy: maps one observation to one action.
        env: unbatched environment with ``pixels`` uint8 ``[C, H, W]``.
        episodes: how many episodes, at least 1.
        seed: seed of this evaluation.
        record_episodes: keep the pictures of the first so many episodes.
        progress: show a bar that vanishes when done (never in log files).

    Returns:
        The episodes in order, and for each recorded one its RGB pictures, uint8 ``[T + 1, 3, H, W]``.

    Raises:
        ValueError: if ``episodes`` is below 1.
    """
    if episodes < 1:
        raise ValueError(f"`episodes` must be at least 1, got {episodes}.")
    results: list[Episode] = []
    videos: list[Tensor] = []
    bar = tqdm(
        range(episodes), desc="evaluate", unit="episode", leave=False, disable=None if progress else True
    )
    for index in bar:
        episode, pictures = run_episode(
            policy, env, episode=index, seed=episode_seed(seed, index), is_recorded=index < record_episodes
        )
        results.append(episode)
        if pictures is not None:
            videos.append(pictures)
        bar.set_postfix(mean_return=f"{sum(e.episode_return for e in results) / len(results):.1f}")
    return results, videos


def run_episode(
    policy: Policy, env: EnvBase, *, episode: int, seed: int, is_recorded: bool
) -> tuple[Episode, Tensor | None]:
    """Run ``policy`` for one whole episode.

    Args:
        policy: maps one observation to one action.
        env: unbatched environment with ``pixels`` uint8 ``[C, H, W]``.
        episode: index within the evaluation.
        seed: what the environment is seeded with before its reset.
        is_recorded: also return the pictures.

    Returns:
        The episode, and its RGB pictures uint8 ``[T + 1, 3, H, W]`` or ``None``.
    """
    env.set_seed(seed)
    observation = env.reset()
    pictures = [observation["pixels"][-3:].clone()] if is_recorded else None
    episode_return, agent_steps, done = 0.0, 0, False
    while not done:
        observation["action"] = policy(observation["pixels"])
        transition = env.step(observation)
        episode_return += transition["next", "reward"].item()
        agent_steps += 1
        done = bool(transition["next", "done"].item())
        observation = step_mdp(transition)
        if pictures is not None:
            pictures.append(observation["pixels"][-3:].clone())
    result = Episode(episode, episode_return, agent_steps, seed)
    return result, None if pictures is None else torch.stack(pictures)


def episode_seed(seed: int, episode: int) -> int:
    """Return what the environment of an evaluation's episode is seeded with."""
    return derive_seed(seed, "episode", episode)


def uniform_policy(env: EnvBase, *, seed: int) -> Policy:
    """Return the uniform random policy on ``[-1, 1]^A``, the control every result is read against."""
    generator = torch.Generator().manual_seed(derive_seed(seed, "uniform_policy"))
    action_dim = env.action_spec.shape[-1]

    def act(pixels: Tensor) -> Tensor:
        return torch.rand(action_dim, generator=generator) * 2 - 1

    return act


def summarize(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return ``mean``, ``std`` (unbiased; 0 for one episode), ``min`` and ``max`` of the episode returns."""
    returns = [e.episode_return for e in episodes]
    return {
        "mean": statistics.fmean(returns),
        "std": statistics.stdev(returns) if len(returns) > 1 else 0.0,
        "min": min(returns),
        "max": max(returns),
    }

"""One domain of an active pre-training: its environment, its replay, its agent, and where it stands."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import step_mdp

from crptpro.data import FrameReplay
from crptpro.errors import CRPTproError
from crptpro.seeding import derive_seed
from crptpro.training.env_thread import EnvThread
from crptpro.training.explore.agents import ExploringAgent
from crptpro.training.finite import not_finite

logger = logging.getLogger(__name__)

COUNTERS = ("agent_steps", "episodes", "skill")


class Member:
    """Explores one domain, a decision at a time.

    A decision's outcome is taken in when the domain's turn comes again (:meth:`settle`): until then the environment
    may be simulating and drawing in its own thread. The replay is only read in the domain's own turn, so nothing
    depends on when that happens.

    A checkpoint may fall into an episode. No simulator state is kept for it: the episode is played again from its
    seed with the same actions.

    Args:
        name: of the domain.
        env: what is explored; None where nothing more will be decided.
        replay: every transition goes there; likewise.
        agent: decides after ``random_agent_steps`` decisions, uniformly at random before.
        action_dim: A.
        seed: of the run; episodes, actions and skills have streams of their own below it.
        random_agent_steps: decisions taken uniformly at random.
        skill_dim: number of skills, or ``None``; the current one is stored with every transition.
        skill_agent_steps: decisions that a skill is kept for; a new episode draws a new one, too.
    """

    def __init__(
        self,
        name: str,
        env: EnvThread | None,
        replay: FrameReplay | None,
        agent: ExploringAgent,
        *,
        action_dim: int,
        seed: int,
        random_agent_steps: int,
        skill_dim: int | None = None,
        skill_agent_steps: int = 50,
    ) -> None:
        self.name, self.agent, self.action_dim = name, agent, action_dim
        self._env, self._replay = env, replay
        self.seed, self.random_agent_steps = seed, random_agent_steps
        self.skill_dim, self.skill_agent_steps = skill_dim, skill_agent_steps
        self.generators = {
            stream: torch.Generator().manual_seed(derive_seed(seed, "active", name, stream))
            for stream in ("random_actions", "skill")
        }
        self.agent_steps = self.episodes = self.skill = 0
        self.actions: list[Tensor] = []
        self.finished: dict[str, float] | None = None
        self._observation: TensorDictBase | None = None
        self._action: Tensor | None = None
        self._reward_sum = 0.0

    @property
    def env(self) -> EnvThread:
        """What is explored."""
        assert self._env is not None, "the run has spent its budget"
        return self._env

    @property
    def replay(self) -> FrameReplay:
        """Where every transition goes."""
        assert self._replay is not None, "the run has spent its budget"
        return self._replay

    def decide(self, encoder: nn.Module, device: torch.device) -> None:
        """Choose the next action, from the settled observation, and begin the environment's step.

        Raises:
            NonFiniteError: if the policy has diverged; no simulator should see that.
        """
        self.settle()
        if self._observation is None:
            self._begin_episode()
        elif self.skill_dim is not None and len(self.actions) % self.skill_agent_steps == 0:
            self._draw_skill()
        assert self._observation is not None
        action = self._act(self._observation["pixels"], encoder, device)
        self._observation["action"] = self._action = action
        self.env.begin_step(self._observation)

    def settle(self) -> None:
        """Store the outcome of the step that has begun, if one has."""
        if self._action is None:
            return
        transition = self._in_the_world(self.env.end_step)
        following, action, self._action = transition["next"], self._action, None
        columns = {} if self.skill_dim is None else {"skill": self.one_hot_skill()}
        self.replay.append(
            action,
            following["reward"],
            following["terminated"],
            following["truncated"],
            following["pixels"][-3:],
            **columns,
        )
        self.actions.append(action)
        self._reward_sum += following["reward"].item()
        self.agent_steps += 1
        self._observation = step_mdp(transition)
        if following["done"].item():
            self.finished = {"episode_return": self._reward_sum, "episode_agent_steps": len(self.actions)}
            self.episodes += 1
            self._observation, self.actions, self._reward_sum = None, [], 0.0

    def one_hot_skill(self) -> Tensor:
        """Return the current skill, float32 ``[skill_dim]``."""
        assert self.skill_dim is not None
        return torch.nn.functional.one_hot(torch.tensor(self.skill), self.skill_dim).float()

    def close(self) -> None:
        """Free the render context."""
        if self._env is not None:
            self._env.close()

    def state_dict(self) -> dict[str, Any]:
        """Return where the domain stands; everything that has begun must be settled."""
        assert self._action is None
        actions = torch.stack(self.actions) if self.actions else torch.zeros(0, self.action_dim)
        return {
            "counters": {name: getattr(self, name) for name in COUNTERS},
            "is_running": self._observation is not None,
            "actions": actions,
            "agent": self.agent.state_dict(),
            "replay": self.replay.state_dict(),
            "generators": {name: generator.get_state() for name, generator in self.generators.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`, playing the episode that was under way again."""
        for name, value in state["counters"].items():
            setattr(self, name, value)
        self.agent.load_state_dict(state["agent"])
        if self._env is None:
            return
        self.replay.load_state_dict(state["replay"])
        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name])
        if state["is_running"]:
            self._play_again(list(state["actions"]))

    def _begin_episode(self) -> None:
        self._observation = self._reset()
        self.replay.begin_episode(self._observation["pixels"][-3:])
        if self.skill_dim is not None:
            self._draw_skill()

    def _reset(self) -> TensorDictBase:
        seed = derive_seed(self.seed, "active", self.name, "episode", self.episodes)
        return self._in_the_world(lambda: self.env.reset(seed))

    def _in_the_world(self, work: Callable[[], TensorDictBase]) -> TensorDictBase:
        """Do something in the environment; its errors do not say which of several it was."""
        try:
            return work()
        except CRPTproError:
            raise
        except Exception as reason:
            raise CRPTproError(
                f"The world of {self.name} failed in episode {self.episodes}, decision {len(self.actions)}: {reason!r}."
            ) from reason

    def _draw_skill(self) -> None:
        assert self.skill_dim is not None
        self.skill = int(torch.randint(self.skill_dim, (), generator=self.generators["skill"]))

    @torch.no_grad()
    def _act(self, pixels: Tensor, encoder: nn.Module, device: torch.device) -> Tensor:
        if self.agent_steps < self.random_agent_steps:
            return torch.rand(self.action_dim, generator=self.generators["random_actions"]) * 2 - 1
        features = encoder(pixels.unsqueeze(0).to(device))
        skill = None if self.skill_dim is None else self.one_hot_skill().to(device)
        action = self.agent.act(features, skill).squeeze(0).float().cpu().clamp(-1, 1)
        if not torch.isfinite(action).all():
            raise not_finite(
                f"After {self.agent_steps} decisions the explorer of {self.name} acts {action.tolist()}"
            )
        return action

    def _play_again(self, actions: list[Tensor]) -> None:
        observation = self._reset()
        for action in actions:
            observation["action"] = action
            self.env.begin_step(observation)
            transition = self._in_the_world(self.env.end_step)
            self._reward_sum += transition["next", "reward"].item()
            observation = step_mdp(transition)
        self._observation, self.actions = observation, actions
        stored = self.replay.observations_at(self.replay.live_slots()[-1:])[0]
        if not torch.equal(stored, observation["pixels"]):
            logger.warning(
                "%s does not repeat an episode from its seed and actions; this run will differ from an "
                "uninterrupted one.",
                self.name,
            )

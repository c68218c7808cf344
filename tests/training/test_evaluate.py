from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from crptpro.seeding import derive_seed
from crptpro.training.evaluate import Episode, evaluate, summarize, uniform_policy


class CountingPixels(EnvBase):
    """Ends after three decisions; the reward is the action plus a number that depends on the seed."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(pixels=Bounded(0, 255, (9, 4, 4), dtype=torch.uint8))
        self.action_spec = Bounded(-1, 1, (2,))
        self.reward_spec = Unbounded((1,))
        self.seeds: list[int] = []

    def _set_seed(self, seed: int | None) -> None:
        self.seeds.append(seed)

    def _pixels(self) -> torch.Tensor:
        return torch.full((9, 4, 4), self.count, dtype=torch.uint8)

    def _reset(self, tensordict: TensorDict | None) -> TensorDict:
        self.count = 0
        return TensorDict({"pixels": self._pixels()}, [])

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.count += 1
        done = torch.tensor([self.count == 3])
        reward = tensordict["action"].sum().reshape(1) + self.seeds[-1] % 7
        return TensorDict(
            {"pixels": self._pixels(), "reward": reward, "done": done, "terminated": done & False}, []
        )


def test_returns_are_summed_per_episode_and_each_episode_has_its_own_seed() -> None:
    env = CountingPixels()
    episodes, videos = evaluate(
        lambda pixels: torch.tensor([0.25, 0.25]), env, episodes=2, seed=5, progress=False
    )
    seeds = [derive_seed(5, "episode", e) for e in range(2)]
    assert [e.seed for e in episodes] == seeds
    assert [e.episode_return for e in episodes] == [3 * (0.5 + s % 7) for s in seeds]
    assert [e.agent_steps for e in episodes] == [3, 3]
    assert videos == []


def test_recorded_pictures_are_the_newest_of_each_observation() -> None:
    _, videos = evaluate(
        lambda pixels: torch.zeros(2), CountingPixels(), episodes=2, record_episodes=1, progress=False
    )
    assert len(videos) == 1
    assert videos[0].shape == (4, 3, 4, 4)
    assert videos[0][:, 0, 0, 0].tolist() == [0, 1, 2, 3]


def test_policy_sees_the_observation_it_acts_on() -> None:
    seen = []
    evaluate(
        lambda p: seen.append(int(p[0, 0, 0])) or torch.zeros(2), CountingPixels(), episodes=1, progress=False
    )
    assert seen == [0, 1, 2]


def test_the_uniform_policy_covers_the_action_range_and_follows_its_seed() -> None:
    env = CountingPixels()
    policy, again, other = (
        uniform_policy(env, seed=0),
        uniform_policy(env, seed=0),
        uniform_policy(env, seed=1),
    )
    actions = torch.stack([policy(torch.empty(0)) for _ in range(400)])
    assert actions.shape == (400, 2)
    assert actions.min() < -0.9
    assert actions.max() > 0.9
    assert actions.abs().max() <= 1
    torch.testing.assert_close(again(torch.empty(0)), actions[0])
    assert not torch.equal(other(torch.empty(0)), actions[0])


def test_summary_of_known_returns() -> None:
    episodes = [Episode(i, r, 1, 0) for i, r in enumerate([1.0, 2.0, 6.0])]
    assert summarize(episodes) == pytest.approx({"mean": 3.0, "std": 7**0.5, "min": 1.0, "max": 6.0})
    assert summarize(episodes[:1])["std"] == 0.0


def test_zero_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match="`episodes` must be at least 1, got 0"):
        evaluate(lambda pixels: pixels, CountingPixels(), episodes=0)

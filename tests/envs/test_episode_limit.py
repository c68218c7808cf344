"""Episodes without an end of their own, and worlds that repeat no action."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs
from toy_world import FIXED, ToyEnv

from crptpro.domains import Domain, register_domain
from crptpro.envs import episode_length, factory, make_env, resolve_action_repeat
from crptpro.pretrained import random_pretrained
from crptpro.training import evaluate, train_downstream, uniform_policy


def make_endless(*, seed: int, image_size: int) -> EnvBase:
    return ToyEnv(lambda _: 10**9, seed=seed, image_size=image_size)


def make_repeating(*, seed: int, image_size: int, action_repeat: int) -> EnvBase:
    return ToyEnv(lambda _: 20 // action_repeat, seed=seed, image_size=image_size)


ENDLESS = Domain("endless", "endless_go", make=make_endless)
REPEATING = Domain("repeating", "repeating_go", make=make_repeating, action_repeat=4, episode_env_steps=20)


def test_a_world_without_an_end_is_truncated_and_starts_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factory, "LONGEST_EPISODE_AGENT_STEPS", 7)
    env = make_env(ENDLESS, seed=0, image_size=8)
    check_env_specs(env)
    episodes, _ = evaluate(uniform_policy(env, seed=0), env, episodes=2, progress=False)
    assert [episode.agent_steps for episode in episodes] == [7, 7]
    last = env.rollout(20)["next"]
    assert last["truncated"].squeeze(-1).tolist() == [False] * 6 + [True]
    assert torch.equal(last["done"], last["truncated"])
    assert not last["terminated"].any()


def test_an_end_of_its_own_is_left_alone() -> None:
    assert make_env(FIXED, seed=0, image_size=8).rollout(50).shape == (10,)


def test_a_world_that_repeats_nothing_has_one_env_step_per_agent_step() -> None:
    assert resolve_action_repeat(ENDLESS) == resolve_action_repeat(ENDLESS, 4) == 1
    assert resolve_action_repeat(REPEATING) == 4
    assert resolve_action_repeat(REPEATING, 2) == 2
    assert resolve_action_repeat("cheetah") == 2
    assert episode_length(REPEATING) == 5


@pytest.mark.parametrize(("domain", "repeat"), [(FIXED, 1), (REPEATING, 4)])
def test_downstream_counts_env_steps_by_what_the_world_repeats(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, domain: Domain, repeat: int
) -> None:
    monkeypatch.setattr("crptpro.domains._registered", {}, raising=False)
    register_domain(domain)
    result = train_downstream(
        domain.task, random_pretrained(seed=0, channels=(4, 4), strides=(2, 1), image_size=12), run_dir=tmp_path,
        env_steps=40, random_agent_steps=4, batch_size=4, replay_capacity=60, hidden_dim=16, eval_episodes=1,
        eval_interval_env_steps=20, checkpoint_interval_env_steps=20, precision="fp32", progress=False,
    )  # fmt: skip
    assert result.env_steps == 40
    assert result.evaluations[-1]["agent_steps"] == 40 // repeat
    assert {row["env_steps"] for row in result.evaluations} == {0, 20, 40}

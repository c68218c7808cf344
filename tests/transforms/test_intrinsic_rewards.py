"""All intrinsic rewards: the same on an environment of N as on a batch of N, and what a single one earns."""

from __future__ import annotations

import copy

import pytest
import torch
from fake_pixel_env import EPISODE, FakePixelEnv, small_encoder, small_heads
from tensordict import TensorDict
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from crptpro.transforms import (
    FrozenEncoder,
    IntrinsicReward,
    ParticleReward,
    PrototypeReward,
    SkillContrastReward,
)

N = 5


def prototype(encoder, **options):
    projector, prototypes = small_heads(encoder)
    draws = torch.Generator().manual_seed(0)
    return PrototypeReward(projector, prototypes, queue_size=32, generator=draws, **options)


def particle(encoder, **options):
    return ParticleReward(small_heads(encoder)[0], k=3, **options)


def skill_contrast(encoder, **options):
    return SkillContrastReward(small_heads(encoder)[0], **options)


each = pytest.mark.parametrize("make", [prototype, particle, skill_contrast])


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


def environment(reward: IntrinsicReward, encoder, count: int = N) -> TransformedEnv:
    base = FakePixelEnv() if count == 1 else SerialEnv(count, FakePixelEnv)
    env = TransformedEnv(base, Compose(FrozenEncoder(encoder), reward))
    env.set_seed(0)
    return env


@each
def test_a_vectorised_environment_earns_at_every_step_what_a_replay_batch_of_it_earns(make):
    encoder = small_encoder()
    offline = make(encoder)
    online = copy.deepcopy(offline)
    rollout = environment(online, encoder).rollout(EPISODE)
    for t in range(EPISODE):
        step = rollout[:, t].clone()
        external = step["action"].mean(-1, keepdim=True)
        stored = TensorDict(
            {
                "skill": step["skill"],
                "next": {"features": step["next", "features"], "reward": external},
            },
            [N],
        )
        offline(stored)
        torch.testing.assert_close(stored["next", "intrinsic_reward"], step["next", "intrinsic_reward"])
        torch.testing.assert_close(stored["next", "reward"], step["next", "reward"])
        assert step["next", "intrinsic_reward"].any()
    assert offline.state_dict().keys() == online.state_dict().keys()
    for name, value in offline.state_dict().items():
        torch.testing.assert_close(value, online.state_dict()[name])


@each
def test_a_single_environment_has_a_batch_of_one_which_earns_nothing(make):
    encoder = small_encoder()
    rollout = environment(make(encoder), encoder, count=1).rollout(EPISODE)
    assert not rollout["next", "intrinsic_reward"].any()
    torch.testing.assert_close(rollout["next", "reward"], rollout["action"].mean(-1, keepdim=True))


@each
def test_a_reset_is_not_rewarded_and_teaches_nothing(make):
    encoder = small_encoder()
    reward = make(encoder)
    env = environment(reward, encoder)
    before = copy.deepcopy(reward.state_dict())
    for _ in range(3):
        td = env.reset()
        assert "features" in td
        assert "intrinsic_reward" not in td
    assert all(torch.equal(value, before[name]) for name, value in reward.state_dict().items())


@each
@pytest.mark.parametrize("count", [1, N])
@pytest.mark.parametrize(
    "options", [{}, {"reward_key": None}, {"out_reward_key": "total", "out_keys": "bonus"}]
)
def test_specs_are_registered_and_hold(make, count, options):
    encoder = small_encoder()
    env = environment(make(encoder, **options), encoder, count)
    expected = {
        "reward",
        options.get("out_keys", "intrinsic_reward"),
        options.get("out_reward_key", "reward"),
    }
    assert set(env.full_reward_spec.keys(True, True)) == expected
    lead = () if count == 1 else (N,)
    assert all(spec.shape == (*lead, 1) for spec in env.full_reward_spec.values(True, True))
    check_env_specs(env, seed=0)

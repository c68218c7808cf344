from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fake_envs import painter
from torchrl.envs import GymWrapper, check_env_specs

from crptpro.domains import Domain, get_domain
from crptpro.envs import factory, make_env
from crptpro.envs.base import resize
from crptpro.errors import CRPTproError, RenderingError


@pytest.fixture
def task() -> Iterator[str]:
    with painter() as name:
        yield name


def make(task: str | Domain, **options: Any) -> Any:
    return make_env(task, seed=3, image_size=16, **options)


def test_only_a_mujoco_environment_asks_for_a_backend(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise RenderingError("no GL here")

    monkeypatch.setattr(factory, "select_backend", refuse)
    env = make(task)
    check_env_specs(env)
    assert isinstance(env.base_env, GymWrapper)
    with pytest.raises(RenderingError, match="no GL here"):
        make("gymnasium:HalfCheetah-v5")


def test_the_action_is_scaled_and_repeated_rewards_are_summed_and_one_image_is_drawn(task: str) -> None:
    env = make(task, frame_stack=1)
    td = env.reset()
    td = env.step(td.set("action", torch.tensor([0.5, -1.0])))
    assert td["next", "reward"].item() == 1.0 + 2.0
    np.testing.assert_allclose(env.unwrapped.actions, [[1.0, 0.0]] * 2)
    assert env.unwrapped.renders == 2, "one of the reset, one of the agent step"


def test_its_time_limit_truncates_and_its_own_end_terminates_and_both_stop_the_repeat(task: str) -> None:
    truncated = make(task).rollout(10)["next"]
    assert truncated["truncated"].flatten().tolist() == [False, False, True]
    assert not truncated["terminated"].any()
    assert truncated["reward"][-1].item() == 5.0
    with painter(end=3) as ending:
        terminated = make(ending).rollout(10)["next"]
    assert terminated["terminated"].flatten().tolist() == [False, True]
    assert not terminated["truncated"].any()


def test_a_seed_waits_for_the_next_reset_is_used_by_it_alone_and_leaves_torchs_generator_alone(task: str) -> None:
    env = make(task, frame_stack=1)
    first, second = env.reset()["pixels"], env.reset()["pixels"]
    state = torch.get_rng_state()
    env.set_seed(3)
    assert torch.equal(torch.get_rng_state(), state)
    shown = env.step(env.rand_action(env.reset()))["next", "pixels"]
    assert torch.equal(shown, first + 2)
    assert torch.equal(env.reset()["pixels"], second)
    assert not torch.equal(first, second)


def test_without_rendering_rewards_and_episodes_are_the_same(task: str) -> None:
    looking, blind = (make(task, render=render).rollout(10) for render in (True, False))
    for key in (("next", "reward"), ("next", "done"), ("next", "truncated")):
        assert (blind[key] == looking[key]).all()
    assert not blind["next", "pixels"].any()


@pytest.mark.parametrize("camera", [1, "side"])
def test_an_environment_without_cameras_says_so(task: str, camera: int | str) -> None:
    with pytest.raises(CRPTproError, match=r"cannot be made .*unexpected keyword argument 'camera_(id|name)'"):
        make(replace(get_domain(task), camera=camera))


def test_resizing_averages_and_keeps_the_shape_of_the_scene() -> None:
    stripes, left = torch.zeros(2, 3, 60, 80, dtype=torch.uint8)
    stripes[:, :, ::2] = 200  # finer than the small image can show: must become grey, not vanish or alias
    small = resize(stripes, 20)
    assert small.shape == (3, 20, 20)
    assert small.dtype == torch.uint8
    assert (small.int() - 100).abs().max() <= 10
    assert torch.equal(resize(small, 20), small)
    left[:, :, :40] = 255
    assert resize(left, 20)[:, :, :9].eq(255).all()
    assert resize(left, 20)[:, :, 11:].eq(0).all()


@pytest.mark.gl
@pytest.mark.parametrize("env_id", ["Reacher-v5", "HalfCheetah-v5"])
def test_a_mujoco_episode_is_drawn_the_same_whatever_was_drawn_before_it(env_id: str) -> None:
    first, second = (make_env(f"gymnasium:{env_id}", seed=seed, quality="fast", physics_state=True) for seed in (1, 2))
    other, alone = first.reset(), second.reset()
    first.set_seed(2)
    again = first.reset()
    moved = first.step(first.rand_action(again.clone()))["next"]
    first.close()
    second.close()
    assert torch.equal(again["pixels"], alone["pixels"])
    assert not torch.equal(other["pixels"], alone["pixels"])
    assert alone["pixels"].shape == (9, 84, 84)
    assert alone["pixels"].unique().numel() > 10
    assert not torch.equal(moved["pixels"][-3:], again["pixels"][-3:])
    assert moved["qpos"].dtype == torch.float64
    assert not torch.equal(moved["qpos"], again["qpos"])


@pytest.mark.gl
@pytest.mark.parametrize("camera", [5, "trakc"])  # for 5 MuJoCo would end the process
def test_a_camera_that_a_mujoco_model_has_not_is_refused_with_those_it_has(camera: int | str) -> None:
    with pytest.raises(CRPTproError, match=rf"has no camera {camera!r}; its model has 1, from 0 on: \['track'\]"):
        make_env(replace(get_domain("gymnasium:HalfCheetah-v5"), camera=camera), seed=0)
    make_env(replace(get_domain("gymnasium:HalfCheetah-v5"), camera="track"), seed=0).close()

from __future__ import annotations

import pytest
import torch
from fake_simulator import FakeSimulator
from torchrl.envs import check_env_specs

from crptpro.envs.pixel_env import PixelEnv


@pytest.mark.parametrize("physics_state", [False, True])
def test_specs_hold(physics_state: bool) -> None:
    check_env_specs(PixelEnv(FakeSimulator(), image_size=8, physics_state=physics_state))


def test_one_render_per_reset_and_per_agent_step() -> None:
    simulator = FakeSimulator(length=100)
    PixelEnv(simulator, image_size=8).rollout(5)
    assert simulator.calls == ["reset", "render", *["step", "render"] * 5]


def test_images_are_chw_and_survive_the_simulators_reused_buffer() -> None:
    env = PixelEnv(FakeSimulator(), image_size=8)
    first = env.reset()
    second = env.step(env.rand_action(first))["next"]
    assert first["pixels"].shape == (3, 8, 8)
    assert first["pixels"][0].eq(0).all()
    assert second["pixels"][0].eq(1).all()
    assert second["pixels"][1, 0].eq(200).all()
    assert second["pixels"][1, 1].eq(1).all()


@pytest.mark.parametrize("is_terminal", [False, True])
def test_time_limits_truncate_and_ends_terminate(is_terminal: bool) -> None:
    rollout = PixelEnv(FakeSimulator(length=4, is_terminal=is_terminal), image_size=8).rollout(10)
    assert rollout["next", "done"].flatten().tolist() == [False, False, False, True]
    assert rollout["next", "terminated"][-1].item() is is_terminal
    assert rollout["next", "truncated"][-1].item() is not is_terminal


def test_reward_and_action_are_float32_vectors() -> None:
    rollout = PixelEnv(FakeSimulator(), image_size=8).rollout(3)
    assert rollout["next", "reward"].dtype == rollout["action"].dtype == torch.float32
    assert rollout["next", "reward"].shape == (3, 1)
    assert rollout["action"].shape == (3, 2)
    assert rollout["action"].abs().max() <= 1


def test_physics_state_is_float64_of_the_same_moment_as_the_image() -> None:
    rollout = PixelEnv(FakeSimulator(), image_size=8, physics_state=True).rollout(3)
    assert rollout["next", "qpos"].dtype == rollout["next", "qvel"].dtype == torch.float64
    assert rollout["next", "qpos"][:, 0].tolist() == [1.0, 2.0, 3.0]
    assert rollout["next", "qvel"].shape == (3, 2)


def test_a_world_without_physics_has_no_physics_state() -> None:
    simulator = FakeSimulator()
    simulator.state_size = None  # type: ignore[assignment]
    assert "qpos" not in PixelEnv(simulator, image_size=8, physics_state=True).reset()


def test_set_seed_waits_for_the_next_reset() -> None:
    simulator = FakeSimulator()
    env = PixelEnv(simulator, image_size=8)
    first = env.reset()
    env.set_seed(7)
    assert simulator.calls.count("reset") == 1
    assert env.step(env.rand_action(first))["next", "pixels"][0, 1, 0] == 1
    assert env.reset()["pixels"][0, 1, 0] == 70


def test_set_seed_leaves_torchs_generator_alone() -> None:
    env = PixelEnv(FakeSimulator(), image_size=8)
    state = torch.get_rng_state()
    env.set_seed(7)
    assert torch.equal(torch.get_rng_state(), state)


def test_closing_twice_is_harmless() -> None:
    env = PixelEnv(FakeSimulator(), image_size=8)
    env.close()
    env.close()
    assert env.is_closed


def test_without_rendering_nothing_is_drawn_and_rewards_and_episodes_are_the_same() -> None:
    simulators = FakeSimulator(), FakeSimulator()
    looking, blind = (
        PixelEnv(s, image_size=8, render=r).rollout(10) for s, r in zip(simulators, (True, False))
    )
    assert "render" in simulators[0].calls
    assert "render" not in simulators[1].calls
    for key in (("next", "reward"), ("next", "done"), ("next", "truncated")):
        torch.testing.assert_close(blind[key], looking[key])
    assert blind["next", "pixels"].eq(0).all()
    check_env_specs(PixelEnv(FakeSimulator(), image_size=8, render=False))

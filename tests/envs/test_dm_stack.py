from __future__ import annotations

import numpy as np
import pytest
from fake_simulator import FakeDmEnv, StubCamera

from crptpro.domains import Domain, get_domain
from crptpro.envs.dm_stack import DmControlSimulator, load_dm_env
from crptpro.envs.pixel_env import PixelEnv
from crptpro.envs.rendering import select_backend
from crptpro.errors import CRPTproError, UnknownNameError


def simulator_of(env: FakeDmEnv, action_repeat: int = 2) -> DmControlSimulator:
    return DmControlSimulator(env, StubCamera(), action_repeat=action_repeat)  # type: ignore[arg-type]


def test_rewards_of_repeated_env_steps_are_summed() -> None:
    simulator = simulator_of(FakeDmEnv(length=10), action_repeat=3)
    simulator.reset()
    assert simulator.step(np.zeros(2, np.float32)) == (1.0 + 2.0 + 3.0, False, False)


def test_the_repeat_stops_where_the_episode_ends() -> None:
    env = FakeDmEnv(length=5)
    simulator = simulator_of(env)
    simulator.reset()
    outcomes = [simulator.step(np.zeros(2, np.float32)) for _ in range(3)]
    assert outcomes[-1] == (5.0, False, True)
    assert env.env_steps == 5


def test_a_last_step_without_discount_is_a_termination() -> None:
    simulator = simulator_of(FakeDmEnv(length=1, last_discount=0.0))
    simulator.reset()
    outcome = simulator.step(np.zeros(2, np.float32))
    assert (outcome.terminated, outcome.truncated) == (True, False)


def test_actions_are_mapped_to_the_actuators_ranges() -> None:
    env = FakeDmEnv()
    simulator = simulator_of(env, action_repeat=1)
    simulator.reset()
    for action in ([-1, -1], [1, 1], [0, 0.5]):
        simulator.step(np.array(action, np.float32))
    np.testing.assert_allclose(env.actions, [[-1.0, -0.8], [1.1, 0.8], [0.05, 0.4]], atol=1e-12)


@pytest.mark.parametrize("bound", [np.inf, 1e10])
def test_an_actuator_without_bounds_takes_the_action_as_it_is(bound: float) -> None:
    env = FakeDmEnv()
    spec = env.action_spec().replace(minimum=np.array([-bound, 0.0]), maximum=np.array([bound, 4.0]))
    env.action_spec = lambda: spec  # type: ignore[method-assign]
    simulator = simulator_of(env, action_repeat=1)
    simulator.reset()
    for action in ([-1, -1], [0.5, 1]):
        simulator.step(np.array(action, np.float32))
    np.testing.assert_allclose(env.actions, [[-1.0, 0.0], [0.5, 4.0]], atol=1e-12)


@pytest.mark.parametrize("bound", [np.inf, 1e10])
def test_an_actuator_that_is_bounded_on_one_side_is_refused(bound: float) -> None:
    env = FakeDmEnv()
    spec = env.action_spec().replace(maximum=np.array([bound, 1.0]))
    env.action_spec = lambda: spec  # type: ignore[method-assign]
    with pytest.raises(CRPTproError, match="one side only"):
        simulator_of(env)


def test_seeding_reaches_the_generator_of_either_kind_of_environment() -> None:
    suite_like, composer_like = FakeDmEnv(), FakeDmEnv()
    composer_like.random_state = np.random.RandomState(0)
    simulator_of(suite_like).seed(3)
    simulator_of(composer_like).seed(3)
    expected = np.random.RandomState(3).rand()
    assert suite_like.task.random.rand() == composer_like.random_state.rand() == expected


@pytest.mark.gl
@pytest.mark.parametrize(("task", "agent_steps"), [("pendulum", 500), ("cheetah", 500), ("reach_duplo", 125)])
def test_a_full_episode_is_truncated_and_not_terminated(task: str, agent_steps: int) -> None:
    select_backend()
    simulator = DmControlSimulator(load_dm_env(get_domain(task)), StubCamera())  # type: ignore[arg-type]
    env = PixelEnv(simulator, image_size=8)
    rollout = env.rollout(agent_steps + 10)
    env.close()
    assert len(rollout) == agent_steps
    assert rollout["next", "truncated"].sum() == rollout["next", "truncated"][-1] == 1
    assert rollout["next", "terminated"].sum() == 0


@pytest.mark.gl
def test_a_suite_task_may_be_registered_under_another_domain_name() -> None:
    select_backend()
    env = load_dm_env(Domain("seen_from_behind", "acrobot_swingup", camera=0, source="suite"))
    assert env.physics.model.nq == 2
    with pytest.raises(UnknownNameError, match="acrobot_dance"):
        load_dm_env(Domain("own", "acrobot_dance", source="suite"))


@pytest.mark.gl
def test_built_in_cameras_of_manipulation_do_not_render(monkeypatch: pytest.MonkeyPatch) -> None:
    select_backend()
    env = load_dm_env(get_domain("reach_duplo"))
    from dm_control.mujoco import engine

    monkeypatch.setattr(engine.Camera, "render", lambda *_, **__: pytest.fail("something rendered"))
    assert env.reset().observation == {}
    env.step(np.zeros(9))
    env.close()

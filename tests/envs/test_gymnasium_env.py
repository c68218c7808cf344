from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from crptpro.domains import Domain
from crptpro.envs import factory, make_env, needs_gl
from crptpro.envs.gymnasium_env import resize
from crptpro.errors import CRPTproError, RenderingError

BOX = gymnasium.spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 1.0]), dtype=np.float64)


class Painter(gymnasium.Env[np.ndarray, np.ndarray]):
    """Paints its clock without GL; ends after ``end`` steps."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, action_space: Any = BOX, end: int = 1000, image: Any = None, render_mode: str = ""):
        self.action_space, self.observation_space = action_space, gymnasium.spaces.Box(0, 1, (1,))
        self.end, self.image, self.render_mode = end, image, render_mode
        self.clock, self.actions = 0, []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.clock, self.start = 0, int(self.np_random.integers(100))
        return np.zeros(1), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.actions.append(action)
        self.clock += 1
        return np.zeros(1), float(self.clock), self.clock >= self.end, False, {}

    def render(self) -> Any:
        return np.full((60, 80, 3), self.start + self.clock, np.uint8) if self.image is None else self.image


@pytest.fixture(autouse=True)
def _painters(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def no_backend() -> str:
        raise RenderingError("no GL here")

    monkeypatch.setattr(factory, "select_backend", no_backend)
    discrete = gymnasium.spaces.Discrete(3)
    unbounded = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    options: dict[str, dict[str, Any]] = {
        "Painter": {}, "Short": {"end": 3}, "Discrete": {"action_space": discrete},
        "Unbounded": {"action_space": unbounded}, "Text": {"image": "no picture"},
    }  # fmt: skip
    ids = [f"Crptpro{name}-v0" for name in options]
    for env_id, kwargs in zip(ids, options.values()):
        gymnasium.register(env_id, Painter, max_episode_steps=5, kwargs=kwargs, disable_env_checker=True)
    yield
    for env_id in ids:
        del gymnasium.registry[env_id]


def make_painter(name: str = "Painter", **options: Any) -> Any:
    return make_env(f"gymnasium:Crptpro{name}-v0", seed=3, image_size=16, **options)


def test_specs_hold_for_an_environment_that_draws_without_gl() -> None:
    env = make_painter()
    check_env_specs(env)
    env.close()


def test_an_environment_that_draws_without_gl_asks_for_no_backend_and_names_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(factory, "select_backend", lambda: pytest.fail("a GL backend was proven"))
    env = make_painter()
    card = env.card()
    assert card["backend"] == "none"
    assert not [name for name in card if name.startswith("gl_")]
    env.close()


@pytest.mark.parametrize(
    ("task", "answer"),
    [
        ("walker_run", True), ("reach_duplo", True), ("gymnasium:HalfCheetah-v5", True),
        ("gymnasium:Pendulum-v1", False), ("gymnasium:CrptproPainter-v0", False),
        (Domain("own", "own", make=lambda: None), False),
    ],
)  # fmt: skip
def test_who_needs_gl(task: Any, answer: bool) -> None:
    assert needs_gl(task) is answer


def test_a_mujoco_environment_needs_a_gl_backend() -> None:
    with pytest.raises(RenderingError, match="no GL here"):
        make_env("gymnasium:HalfCheetah-v5", seed=0)


def test_the_action_is_scaled_and_repeated_and_rewards_are_summed() -> None:
    env = make_painter(frame_stack=1)
    td = env.reset()
    td = env.step(td.set("action", torch.tensor([0.5, -1.0])))
    assert td["next", "reward"].item() == 1.0 + 2.0
    np.testing.assert_allclose(env.simulator._env.unwrapped.actions, [[1.0, 0.0]] * 2)


def test_its_time_limit_truncates_and_stops_the_repeat() -> None:
    rollout = make_painter().rollout(10)
    assert rollout["next", "truncated"].flatten().tolist() == [False, False, True]
    assert not rollout["next", "terminated"].any()
    assert rollout["next", "reward"][-1].item() == 5.0


def test_its_own_end_terminates() -> None:
    rollout = make_painter("Short").rollout(10)
    assert rollout["next", "terminated"].flatten().tolist() == [False, True]
    assert not rollout["next", "truncated"].any()


def test_a_seed_is_used_by_the_next_reset_alone() -> None:
    env = make_painter(frame_stack=1)
    first, second = env.reset()["pixels"], env.reset()["pixels"]
    env.set_seed(3)
    assert torch.equal(env.reset()["pixels"], first)
    assert torch.equal(env.reset()["pixels"], second)
    assert not torch.equal(first, second)


@pytest.mark.parametrize(
    ("name", "complaint"), [("Discrete", "Discrete actions"), ("Unbounded", "without bounds")]
)
def test_actions_that_are_not_a_bounded_vector_are_refused(name: str, complaint: str) -> None:
    with pytest.raises(CRPTproError, match=complaint):
        make_painter(name)


def test_what_is_no_image_is_refused() -> None:
    with pytest.raises(RenderingError, match="str instead of an RGB image"):
        make_painter("Text").reset()


def test_an_environment_without_cameras_says_so() -> None:
    with pytest.raises(CRPTproError, match="takes no camera"):
        make_painter(camera=1)


def test_resizing_averages_and_keeps_the_shape_of_the_scene() -> None:
    stripes = np.zeros((60, 80, 3), np.uint8)
    stripes[:, ::2] = 200  # finer than the small image can show: must become grey, not vanish or alias
    small = resize(stripes, 20)
    assert small.shape == (20, 20, 3)
    assert small.dtype == np.uint8
    assert np.abs(small.astype(int) - 100).max() <= 10
    left = np.zeros((60, 80, 3), np.uint8)
    left[:, :40] = 255
    assert (resize(left, 20)[:, :9] == 255).all()
    assert (resize(left, 20)[:, 11:] == 0).all()
    np.testing.assert_array_equal(resize(small, 20), small)


@pytest.mark.gl
def test_half_cheetah_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    env = make_env("gymnasium:HalfCheetah-v5", seed=0, quality="fast", physics_state=True)
    check_env_specs(env)
    env.set_seed(1)
    rollout = env.rollout(2)
    assert rollout["next", "pixels"].shape == (2, 9, 84, 84)
    assert rollout["next", "qpos"].shape == (2, 9)
    assert rollout["pixels"][0].unique().numel() > 10
    assert not torch.equal(rollout["pixels"][0, -3:], rollout["next", "pixels"][1, -3:])
    env.close()


@pytest.mark.gl
@pytest.mark.parametrize("env_id", ["Reacher-v5", "HalfCheetah-v5"])
def test_an_episode_is_drawn_the_same_whatever_was_drawn_before_it(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # real rendering

    def first_frame(*seeds: int) -> torch.Tensor:
        env = make_env(f"gymnasium:{env_id}", seed=seeds[0], frame_stack=1)
        try:
            for seed in seeds:
                env.set_seed(seed)
                frame = env.reset()["pixels"]
            return frame
        finally:
            env.close()

    alone = first_frame(2)
    assert torch.equal(first_frame(1, 2), alone)
    assert not torch.equal(first_frame(1), alone), "the seeds draw different poses"

from __future__ import annotations

import functools
import gc
import importlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from fake_envs import PlainEnv, own, painter
from gymnasium.spaces import Box, Discrete
from torchrl.envs import EnvBase

from crptpro.envs import make_env
from crptpro.errors import CRPTproError, EnvCrashedError, EnvOutputError, NonFiniteError

SIZE = 8
HUGE = float(np.finfo(np.float32).max)


def grey(shade: Any, dtype: Any = np.uint8) -> np.ndarray:
    return np.full((SIZE, SIZE, 3), shade, dtype)


@contextmanager
def shows(image: Any, *, library: str, **options: Any) -> Iterator[EnvBase]:
    """An environment of either library that shows ``image(clock)``."""
    if library == "gymnasium":
        with painter(image=image) as task:
            yield make_env(task, seed=0, image_size=SIZE, action_repeat=1, **options)
    else:

        def make() -> EnvBase:
            return PlainEnv(lambda clock: torch.from_numpy(image(clock)))

        yield make_env(own(make), seed=0, image_size=SIZE, **options)


both = pytest.mark.parametrize("library", ["gymnasium", "own"])


@both
@pytest.mark.parametrize("frame_stack", [1, 3])
@pytest.mark.parametrize("is_view", [False, True])
def test_frames_outlive_a_buffer_that_is_used_again(library: str, frame_stack: int, is_view: bool) -> None:
    buffer = grey(0)
    if is_view:  # of a buffer that is laid out as frames are stored
        buffer = np.zeros((3, SIZE, SIZE), np.uint8).transpose(1, 2, 0)

    def reuse(clock: int) -> np.ndarray:
        buffer[:] = clock
        return buffer

    with shows(reuse, library=library, frame_stack=frame_stack) as env:
        shown = env.rollout(3)["next", "pixels"]
    assert shown[:, -1, 0, 0].tolist() == [1, 2, 3]


@both
@pytest.mark.parametrize("dtype", ["uint16", "int64", "bool", "float32", "float64"])
def test_other_numbers_than_bytes_are_refused_with_the_remedy(library: str, dtype: str) -> None:
    with pytest.raises(EnvOutputError, match=f"has dtype {dtype}; .*Multiply floats from 0 to 1 by 255"):  # noqa: SIM117
        with shows(lambda _: grey(1, dtype), library=library) as env:
            env.reset()


@pytest.mark.parametrize(
    ("image", "complaint"),
    [("no picture", "is str"), (None, "NoneType"), (np.zeros((8, 8), np.uint8), r"\(8, 8\)"),
     (np.zeros((8, 8, 4), np.uint8), r"\(8, 8, 4\)")],
)  # fmt: skip
def test_what_is_no_rgb_image_is_refused_at_whatever_step_it_comes(image: Any, complaint: str) -> None:
    with painter(image=lambda clock: grey(clock) if clock < 2 else image) as task:
        env = make_env(task, seed=0, image_size=SIZE, action_repeat=1)
        with pytest.raises(EnvOutputError, match=rf"{task}.*{complaint}"):
            env.rollout(3)


@both
@pytest.mark.parametrize(("shade", "word"), [(0, "black"), (7, "of one shade")])
def test_a_still_episode_is_logged_once(library: str, shade: int, word: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), shows(lambda _: grey(shade), library=library) as env:
        for _ in range(3):
            env.rollout(10)
    assert caplog.text.count("All frames of a whole episode") == 1
    assert word in caplog.text


@both
def test_what_moves_late_or_was_left_early_is_not_reported(library: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), shows(lambda clock: grey(clock // 4), library=library) as env:
        env.rollout(10)
        env.rollout(2)
        env.rollout(2)
    assert not caplog.text


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@both
def test_a_reward_that_is_not_finite_names_environment_episode_and_step(library: str, value: float) -> None:
    def reward(clock: int) -> float:
        return value if clock == 3 else 1.0

    with painter(reward=reward) as task:
        domain = task if library == "gymnasium" else own(lambda: PlainEnv(reward=reward))
        env = make_env(domain, seed=0, image_size=SIZE, action_repeat=1)
        env.rollout(2)
        name = task if library == "gymnasium" else "mine_go"
        with pytest.raises(NonFiniteError, match=rf"'{name}' .*reward .*agent step 3 of episode 1"):
            env.rollout(5)


def test_a_physical_state_that_is_not_finite_is_refused() -> None:
    class Broken(PlainEnv):
        def _observe(self) -> Any:
            return super()._observe() | {"qpos": torch.full((2,), torch.nan, dtype=torch.float64)}

    with pytest.raises(NonFiniteError, match=r"'mine_go' .*qpos"):
        make_env(own(Broken), seed=0, image_size=SIZE, physics_state=True).reset()


@both
def test_an_action_that_is_not_finite_names_environment_episode_and_step_and_reaches_no_simulator(library: str) -> None:
    with shows(grey, library=library) as env:
        td = env.reset().set("action", torch.tensor([0.0, np.nan]))
        with pytest.raises(NonFiniteError, match=r"action .*nan.* agent step 1 of episode 0"):
            env.step(td)


def explode(clock: int) -> Any:
    if clock >= 2:
        raise ValueError("the motor is on fire")
    return 0.0


def test_an_exception_of_an_environments_own_is_passed_on_with_its_name_and_the_call() -> None:
    with painter(image=lambda clock: grey(explode(clock))) as task, pytest.raises(EnvCrashedError) as caught:
        make_env(task, seed=0, image_size=SIZE, action_repeat=1).rollout(3)
    assert isinstance(caught.value.__cause__, ValueError)
    for part in ("the motor is on fire", "ValueError in render()", task, __file__):
        assert part in str(caught.value)
    with pytest.raises(EnvCrashedError, match=r"on fire .*ValueError in step\(\) of the environment 'mine_go'"):
        make_env(own(lambda: PlainEnv(reward=explode)), seed=0, image_size=SIZE).rollout(3)


def test_an_exception_of_an_environments_own_is_never_taken_for_a_setting() -> None:
    def picky(render_mode: str = "") -> Any:
        raise TypeError("unsupported operand type(s) for +: 'int' and 'str'")

    picky.metadata = {"render_modes": ["rgb_array"]}  # type: ignore[attr-defined]
    gymnasium.register("CrptproPicky-v0", picky, disable_env_checker=True)
    with pytest.raises(EnvCrashedError, match=r"unsupported operand.*make\(\).*CrptproPicky") as caught:
        make_env("gymnasium:CrptproPicky-v0", seed=0)
    del gymnasium.registry["CrptproPicky-v0"]
    assert __file__ in str(caught.value)

    def make(quality: str) -> EnvBase:
        raise ValueError("no such quality")

    with pytest.raises(EnvCrashedError, match=r"no such quality \(ValueError in make\(\) of the environment 'mine_go'"):
        make_env(own(make), seed=0)


@pytest.mark.parametrize("limit", [5, None])
def test_a_step_of_the_old_api_is_passed_on_with_what_is_expected(limit: int | None) -> None:
    with painter(limit, answer=lambda clock: (np.zeros(1), 0.0, False, {})) as task:
        env = make_env(task, seed=0, image_size=SIZE)
        with pytest.raises(EnvCrashedError, match=rf"expected 5, got 4.*in step\(\) of the environment '{task}'"):
            env.rollout(2)


@pytest.mark.parametrize(("space", "complaint"), [
    (Discrete(3), "Discrete actions"), (Box(-HUGE, HUGE, (2,)), "without bounds"),
    (Box(-np.inf, np.inf, (2,)), "without bounds"), (Box(0, 10, (2,), np.int64), r"int64 from \[0.0, 0.0\]"),
    (Box(-1.0, 1.0, (0,)), r"from \[\] to \[\]"), (Box(0.0, HUGE, (2,)), "a lower and an upper bound"),
    (Box(1.0, 1.0, (2,)), r"from \[1.0, 1.0\] to \[1.0, 1.0\]"),
])  # fmt: skip
def test_action_spaces_that_cannot_be_mapped_from_minus_1_to_1_are_refused_by_name(space: Any, complaint: str) -> None:
    with painter(action_space=space) as task, pytest.raises(CRPTproError, match=rf"{task}.*{complaint}"):
        make_env(task, seed=0)


def test_specs_do_not_follow_torchs_default_dtype() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        with painter() as task:
            assert make_env(task, seed=0, image_size=SIZE).rollout(1)["next", "reward"].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(("option", "value"), [
    ("seed", -1), ("seed", 2**32), ("image_size", 0), ("action_repeat", 1.5), ("frame_stack", "3"),
    ("quality", "best"), ("colors", "pink"),
])  # fmt: skip
def test_settings_that_cannot_be_are_refused_before_anything_is_loaded(option: str, value: Any) -> None:
    with pytest.raises((ValueError, CRPTproError), match=option):
        make_env("cheetah_run", **({"seed": 0} | {option: value}))


@pytest.mark.gl
def test_what_nobody_closed_is_closed_at_exit_without_a_line() -> None:
    code = """
import warnings
from crptpro.envs import make_env
kept = [make_env(task, seed=0, frame_stack=1) for task in ("gymnasium:Reacher-v5", "cartpole")]
print([tuple(env.reset()["pixels"].shape) for env in kept])
# dm_control's import would show the deprecations of all packages, NumPy's at every env step among them.
warnings.warn_explicit("deprecated", DeprecationWarning, "package.py", 1, module="package")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert "(3, 84, 84), (3, 84, 84)" in done.stdout
    assert done.stderr == ""


def test_an_environment_is_closed_once_however_often_it_is_asked() -> None:
    closed: list[bool] = []

    class Closing(PlainEnv):
        def close(self, *, raise_if_closed: bool = True) -> None:
            closed.append(True)
            super().close(raise_if_closed=raise_if_closed)

    env = make_env(own(Closing), seed=0, image_size=SIZE)
    env.close()
    env.close()
    assert env.is_closed
    assert closed == [True]


def frames(task: str, after_each: Callable[[], None]) -> torch.Tensor:
    env = make_env(task, seed=0, image_size=32)
    action = torch.full(env.action_spec.shape, 0.5)
    shown = env.rollout(5, lambda td: td.set("action", action), lambda *_: after_each())["next", "pixels"][:, -3:]
    env.close()
    return shown


@functools.cache
def frames_alone(task: str) -> torch.Tensor:
    return frames(task, lambda: None)


@pytest.mark.gl
@pytest.mark.parametrize("is_closed", [True, False])
@pytest.mark.parametrize("other", ["cartpole_balance", "gymnasium:Reacher-v5"])
@pytest.mark.parametrize("task", ["cartpole_balance", "gymnasium:Reacher-v5"])
def test_environments_that_come_and_go_change_no_frame_of_another(task: str, other: str, is_closed: bool) -> None:
    beside: list[EnvBase] = []

    def come_and_go() -> None:
        if beside:  # closed or not, it is garbage from here on, and collected while the other one is drawn
            beside.clear()
            gc.collect()
            return
        beside.append(make_env(other, seed=1, image_size=32))
        beside[-1].reset()
        if is_closed:
            beside[-1].close()

    expected = frames_alone(task)
    assert expected.float().std() > 1
    assert torch.equal(frames(task, come_and_go), expected)


@pytest.mark.gl
def test_a_frame_leaves_no_context_current_and_the_driver_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """With eglReleaseThread after every image, 12 processes on an NVIDIA driver made 2 agent steps/s each, not 114."""
    env = make_env("cartpole_balance", seed=0, image_size=32)
    td = env.reset()
    if os.environ["MUJOCO_GL"] != "egl":
        pytest.skip("this machine does not render with EGL")
    egl = importlib.import_module("OpenGL.EGL")
    monkeypatch.setattr(egl, "eglReleaseThread", lambda: pytest.fail("the driver's thread was taken down"))
    td["action"] = torch.zeros(env.action_spec.shape)
    env.step(td)
    assert not egl.eglGetCurrentContext()
    monkeypatch.undo()
    env.close()

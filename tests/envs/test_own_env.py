from __future__ import annotations

import functools
import logging
from typing import Any

import numpy as np
import pytest
import torch
from fake_simulator import FakeSimulator
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import DTypeCastTransform, ExcludeTransform, PermuteTransform, UnsqueezeTransform

from crptpro.data.collect_worker import EpisodeJob, EpisodeRoller
from crptpro.domains import Domain
from crptpro.envs import make_env, resolve_action_repeat
from crptpro.envs.pixel_env import PixelEnv
from crptpro.errors import CRPTproError


def make_chw(seed: int, image_size: int) -> EnvBase:
    return PixelEnv(FakeSimulator(image_size=image_size), image_size=image_size, physics_state=True)


def make_hwc(image_size: int, **_: Any) -> EnvBase:
    return TransformedEnv(make_chw(0, image_size), PermuteTransform((-2, -1, -3), in_keys=["pixels"]))


def own(make: Any) -> Domain:
    return Domain("own", "own", make=make)


@pytest.mark.parametrize("make", [make_chw, make_hwc])
def test_own_pixels_are_stacked_channels_first(make: Any) -> None:
    env = make_env(own(make), seed=2, image_size=8)
    check_env_specs(env)
    env.set_seed(2)
    rollout = env.rollout(3)
    assert rollout["next", "pixels"].shape == (3, 9, 8, 8)
    assert rollout["pixels"][0, :, 1, 0].tolist() == [20] * 9
    assert rollout["next", "pixels"][1, :, 1, 0].tolist() == [20] * 3 + [21] * 3 + [22] * 3
    assert rollout["next", "pixels"][1, 1::3, 0].eq(200).all(), "the green top row is elsewhere"


def test_other_keys_are_dropped_and_the_physics_state_is_kept_on_request() -> None:
    plain = make_env(own(make_chw), seed=0, image_size=8)
    assert set(plain.observation_spec.keys()) == {"pixels"}
    full = make_env(own(make_chw), seed=0, image_size=8, physics_state=True, frame_stack=1)
    assert set(full.observation_spec.keys()) == {"pixels", "qpos", "qvel"}
    check_env_specs(full)


def test_what_a_partial_has_bound_is_decided() -> None:
    given: dict[str, Any] = {}

    def make(image_size: int, action_repeat: int, camera: str) -> EnvBase:
        given.update(action_repeat=action_repeat, camera=camera)
        return make_chw(0, image_size)

    domain = own(functools.partial(make, action_repeat=4, camera="side"))
    make_env(domain, seed=0, image_size=8)
    assert given == {"action_repeat": 4, "camera": "side"}
    assert resolve_action_repeat(domain) == 4


def test_an_option_that_make_does_not_take_is_said_to_do_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        make_env(own(make_chw), seed=0, image_size=8, action_repeat=1)
        assert caplog.text == ""
        make_env(own(make_chw), seed=0, image_size=8, action_repeat=4, quality="fast")
    assert "a decision is 1 env step(s), not 4" in caplog.text
    assert "takes no quality" in caplog.text


def test_make_is_given_what_its_signature_names() -> None:
    given: dict[str, Any] = {}

    def make(image_size: int, quality: str, action_repeat: int) -> EnvBase:
        given.update(image_size=image_size, quality=quality, action_repeat=action_repeat)
        return make_chw(0, image_size)

    make_env(own(make), seed=0, image_size=8, quality="fast", action_repeat=3)
    assert given == {"image_size": 8, "quality": "fast", "action_repeat": 3}


class DoubleEnv(PixelEnv):
    """Takes float64 actions and gives float64 rewards."""

    def __init__(self) -> None:
        super().__init__(FakeSimulator(), image_size=8)
        self.action_spec = Bounded(-1.0, 1.0, shape=(2,), dtype=torch.float64)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float64)

    def _step(self, tensordict: Any) -> Any:
        assert tensordict["action"].dtype == torch.float64
        outcome = super()._step(tensordict.clone().set("action", tensordict["action"].float()))
        return outcome.set("reward", outcome["reward"].double())


def make_double() -> EnvBase:
    return DoubleEnv()


def test_float64_actions_and_rewards_become_float32() -> None:
    env = make_env(own(make_double), seed=0, image_size=8)
    check_env_specs(env)
    rollout = env.rollout(2)
    assert rollout["action"].dtype == rollout["next", "reward"].dtype == torch.float32


class EndingEnv(PixelEnv):
    """Knows no truncation, as many environments do: ``done`` and ``terminated`` alone."""

    def __init__(self) -> None:
        super().__init__(FakeSimulator(is_terminal=True, length=3), image_size=8)
        self.done_spec = Categorical(2, shape=(1,), dtype=torch.bool)
        assert set(self.full_done_spec.keys()) == {"done", "terminated"}

    def _reset(self, *args: Any, **kwargs: Any) -> Any:
        return super()._reset(*args, **kwargs).exclude("truncated")

    def _step(self, tensordict: Any) -> Any:
        return super()._step(tensordict).exclude("truncated")


def make_ending() -> EnvBase:
    return EndingEnv()


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_an_environment_without_truncation_is_never_truncated(frame_stack: int) -> None:
    env = make_env(own(make_ending), seed=0, image_size=8, frame_stack=frame_stack)
    check_env_specs(env)
    rollout = env.rollout(10)
    assert rollout["next", "terminated"].flatten().tolist() == [False, False, True]
    assert not rollout["next", "truncated"].any()
    assert rollout["next", "truncated"].dtype == torch.bool


def test_an_environment_without_truncation_can_be_collected() -> None:
    roller = EpisodeRoller(functools.partial(make_env, own(make_ending), seed=0, image_size=8, frame_stack=1))
    natural = roller.roll(EpisodeJob("own", 0, env_seed=0, action_seed=0, limit=9))
    cut = roller.roll(EpisodeJob("own", 1, env_seed=1, action_seed=1, limit=2))
    roller.close()
    assert (natural.terminated.tolist(), natural.is_cut) == ([False, False, True], False)
    assert (cut.truncated.tolist(), cut.is_cut) == ([False, True], True)


def elsewhere(**_: Any) -> EnvBase:
    env = make_chw(0, 8)
    return env.to("meta")


def unscaled(**_: Any) -> EnvBase:
    env = make_chw(0, 8)
    env.action_spec = Bounded(-2.0, 2.0, shape=(2,), dtype=torch.float32)
    return env


def without_pixels(**_: Any) -> EnvBase:
    return TransformedEnv(make_chw(0, 8), ExcludeTransform("pixels"))


def float_pixels(**_: Any) -> EnvBase:
    return TransformedEnv(make_chw(0, 8), DTypeCastTransform(torch.uint8, torch.float32, in_keys=["pixels"]))


def stacked(**_: Any) -> EnvBase:
    return TransformedEnv(make_chw(0, 8), UnsqueezeTransform(-4, in_keys=["pixels"]))


def batched(**_: Any) -> EnvBase:
    return SerialEnv(2, functools.partial(make_chw, 0, 8))


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (unscaled, r"bounds other than \[-1, 1\]"),
        (without_pixels, "no 'pixels'"),
        (float_pixels, r"torch\.float32; they must be torch\.uint8"),
        (stacked, r"shape \(1, 3, 8, 8\)"),
        (batched, "batch size"),
        (elsewhere, "lives on meta; it must be on the CPU"),
        (lambda **_: np.zeros(3), "ndarray; make must return a TorchRL EnvBase"),
        (None, "no make"),
    ],
)
def test_a_broken_contract_is_named(make: Any, complaint: str) -> None:
    with pytest.raises(CRPTproError, match=complaint):
        make_env(own(make), seed=0, image_size=8)

from __future__ import annotations

import functools
import logging
from typing import Any

import numpy as np
import pytest
import torch
from fake_envs import PlainEnv, own
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import ExcludeTransform, InitTracker, RewardSum, StepCounter, UnsqueezeTransform

from crptpro.domains import Domain
from crptpro.envs import episode_length, factory, make_env, resolve_action_repeat
from crptpro.errors import CRPTproError

each_stack = pytest.mark.parametrize("frame_stack", [1, 3])


def make_chw(seed: int, image_size: int) -> EnvBase:
    return PlainEnv()


def make_hwc(**_: Any) -> EnvBase:
    def pixels(clock: int) -> torch.Tensor:
        image = torch.full((8, 8, 3), clock, dtype=torch.uint8)
        image[0, :, 1] = 200  # the top row is greener: catches swapped axes
        return image

    return PlainEnv(pixels)


def checked(make: Any, **options: Any) -> EnvBase:
    env = make_env(own(make), seed=0, image_size=8, **options)
    check_env_specs(env)
    env.set_seed(0)
    return env


@each_stack
@pytest.mark.parametrize("make", [make_chw, make_hwc])
def test_own_pixels_are_stacked_channels_first(make: Any, frame_stack: int) -> None:
    env = checked(make, frame_stack=frame_stack)
    shown = env.rollout(3)["next", "pixels"][1]
    assert shown.shape == (3 * frame_stack, 8, 8)
    assert shown[::3, 1, 0].tolist() == [0, 1, 2][-frame_stack:]
    assert (shown[1::3, 0] == 200).all() == (make is make_hwc)
    assert set(env.observation_spec.keys()) == {"pixels"}


def test_a_seed_waits_for_the_next_reset_and_the_physical_state_is_kept_on_request() -> None:
    env = make_env(own(make_chw), seed=2, image_size=8, frame_stack=1, physics_state=True)
    assert env.reset()["pixels"].unique().tolist() == [20]
    env.set_seed(5)
    assert env.reset()["pixels"].unique().tolist() == [50]
    assert set(env.observation_spec.keys()) == {"pixels", "qpos", "qvel"}
    assert env.rollout(3)["next", "qpos"][:, 0].tolist() == [1.0, 2.0, 3.0]


@each_stack
def test_entries_that_an_environments_own_transforms_read_back_are_kept(frame_stack: int) -> None:
    parts = (StepCounter, RewardSum, InitTracker)
    env = checked(lambda: TransformedEnv(PlainEnv(), Compose(*(part() for part in parts))), frame_stack=frame_stack)
    assert set(env.observation_spec.keys()) == {"pixels", "step_count", "episode_reward", "is_init"}
    rollout = env.rollout(3)["next"]
    assert rollout["step_count"].flatten().tolist() == [1, 2, 3]
    assert rollout["episode_reward"].flatten().tolist() == [1.0, 3.0, 6.0]


def test_entries_that_an_environment_without_a_state_reads_back_are_kept() -> None:
    class Stateless(PlainEnv):
        def __init__(self) -> None:
            super().__init__()
            self.state_spec = Composite(observation=self.observation_spec["observation"].clone())

        def _step(self, tensordict: Any) -> Any:
            return super()._step(tensordict).set("observation", tensordict["observation"] + 1)

    rollout = make_env(own(lambda: Stateless()), seed=0, image_size=8).rollout(3)
    assert rollout["next", "observation"][:, 0].tolist() == [1.0, 2.0, 3.0]


def test_make_is_given_what_it_names_and_what_a_partial_has_bound_is_decided() -> None:
    given: dict[str, Any] = {}

    def make(image_size: int, quality: str, action_repeat: int, camera: str) -> EnvBase:
        given.update(image_size=image_size, quality=quality, action_repeat=action_repeat, camera=camera)
        return PlainEnv()

    make_env(own(functools.partial(make, action_repeat=4, camera="side")), seed=0, image_size=8, quality="fast")
    assert given == {"image_size": 8, "quality": "fast", "action_repeat": 4, "camera": "side"}
    make_env(own(make, camera="top"), seed=0, image_size=8, action_repeat=3)
    assert given == {"image_size": 8, "quality": "exact", "action_repeat": 3, "camera": "top"}
    env = make_env(own(PlainEnv), seed=0, image_size=8)  # a class is a function, too
    assert env.rollout(2)["next", "reward"].sum() == 3.0


def test_a_quality_that_make_does_not_take_does_nothing_and_an_action_repeat_is_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    domain = own(make_chw, action_repeat=3)
    with caplog.at_level(logging.WARNING):
        make_env(domain, seed=0, image_size=8, action_repeat=3)
        assert caplog.text == ""
        make_env(domain, seed=0, image_size=8, quality="fast")
    assert "takes no quality: 'fast' changes nothing" in caplog.text
    with pytest.raises(CRPTproError, match=r"takes no action_repeat: an agent step is 3 env step\(s\), not 4"):
        make_env(domain, seed=0, image_size=8, action_repeat=4)


@each_stack
def test_float64_becomes_float32_and_an_environment_without_truncation_is_never_truncated(frame_stack: int) -> None:
    make = functools.partial(PlainEnv, length=3, truncates=False, dtype=torch.float64)
    rollout = checked(lambda: make(), frame_stack=frame_stack).rollout(10)
    assert rollout["action"].dtype == rollout["next", "reward"].dtype == torch.float32
    assert rollout["next", "terminated"].flatten().tolist() == [False, False, True]
    assert not rollout["next", "truncated"].any()


@pytest.mark.parametrize("truncates", [True, False])
def test_an_endless_environment_is_truncated_and_starts_again(truncates: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factory, "LONGEST_EPISODE_AGENT_STEPS", 7)
    env = checked(lambda: PlainEnv(length=10**9, truncates=truncates))
    for _ in range(2):
        last = env.rollout(20)["next"]
        assert last["truncated"].flatten().tolist() == [False] * 6 + [True]
        assert torch.equal(last["done"], last["truncated"])
        assert not last["terminated"].any()
    limited = own(lambda: PlainEnv(length=12), episode_env_steps=12)
    assert make_env(limited, seed=0, image_size=8).rollout(50).shape == (12,)


def test_an_episode_ends_after_the_env_steps_of_its_domain() -> None:
    endless = Domain("endless", "endless_go", make=lambda **_: PlainEnv(length=60), episode_env_steps=10)
    rollout = make_env(endless, seed=0, image_size=8).rollout(60)
    assert len(rollout) == 10
    assert rollout["next", "truncated"][-1]


def test_a_partial_of_a_class_is_given_what_the_class_names() -> None:
    assert len(make_env(own(functools.partial(PlainEnv)), seed=0, image_size=8).rollout(2)) == 2


def test_agent_steps_are_counted_by_what_a_domain_repeats() -> None:
    repeating, endless = own(make_chw, action_repeat=np.int64(4), episode_env_steps=2e1), own(make_chw)
    assert resolve_action_repeat(endless) == 1
    assert (resolve_action_repeat(repeating), resolve_action_repeat(repeating, 2)) == (4, 2)
    for name in ("cheetah", "acrobot_swingup", "lqr", "reach_site", "gymnasium:HalfCheetah-v5"):
        assert resolve_action_repeat(name) == 2
    assert repr(episode_length(repeating)) == "5"
    assert episode_length("cheetah") == episode_length("dog_run") == 500
    assert episode_length("reach_duplo") == episode_length("lift_brick") == 125
    assert episode_length("walker_walk", action_repeat=3) == 334
    assert episode_length("lqr_2_1") is episode_length(endless) is None
    assert episode_length("gymnasium:HalfCheetah-v5") == 500


@pytest.mark.parametrize(("make", "complaint"), [
    (lambda: PlainEnv(bound=2.0), r"bounds other than \[-1, 1\]"),
    (lambda: PlainEnv(actions=0), "bounded float vector"),
    (lambda: TransformedEnv(PlainEnv(), ExcludeTransform("pixels")), "no 'pixels'"),
    (lambda: TransformedEnv(PlainEnv(), UnsqueezeTransform(-4, in_keys=["pixels"])), r"shape \(1, 3, 8, 8\)"),
    (lambda: SerialEnv(1, PlainEnv), "batch size"),
    (lambda: PlainEnv().to("meta"), "is on meta; it must be on the CPU"),
    (lambda: np.zeros(3), "ndarray; make must return a TorchRL EnvBase"),
    (None, "no make"),
])  # fmt: skip
def test_a_broken_contract_is_named(make: Any, complaint: str) -> None:
    with pytest.raises(CRPTproError, match=complaint):
        make_env(own(make), seed=0, image_size=8)


@pytest.mark.parametrize("task", ["gymnasium:HalfCheetah-v5", Domain("own", "own", make=make_chw)])
def test_only_dm_control_environments_have_a_known_background(task: str | Domain) -> None:
    with pytest.raises(CRPTproError, match=r"dm_control.*reversed_image"):
        make_env(task, seed=0, colors="reversed_background")

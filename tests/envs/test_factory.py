from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, check_env_specs

from crptpro.domains import PAPER_DOMAINS, Domain
from crptpro.envs import episode_length, make_env
from crptpro.errors import CRPTproError, UnknownNameError

ACTION_SIZES = {
    "cheetah": 6, "walker": 6, "quadruped": 12, "cartpole": 1, "pendulum": 1, "manipulation": 9, "hopper": 4,
    "finger": 2,
}  # fmt: skip


def play(env: EnvBase, agent_steps: int, *, seed: int | None = None) -> TensorDictBase:
    """A fixed sequence of actions from the next reset on."""
    if seed is not None:
        env.set_seed(seed)
    generator = torch.Generator().manual_seed(0)
    td, seen = env.reset(), []
    for _ in range(agent_steps):
        td["action"] = torch.rand(env.action_spec.shape, generator=generator) * 2 - 1
        stepped, td = env.step_and_maybe_reset(td)
        seen.append(stepped)
    return torch.stack(seen)


@pytest.fixture(scope="module", params=PAPER_DOMAINS)
def paper_env(request: pytest.FixtureRequest) -> Iterator[tuple[str, EnvBase]]:
    env = make_env(request.param, seed=0, physics_state=True)
    yield request.param, env
    env.close()


@pytest.mark.gl
def test_every_paper_domain_keeps_its_specs(paper_env: tuple[str, EnvBase]) -> None:
    name, env = paper_env
    check_env_specs(env)
    assert env.action_spec.shape == (ACTION_SIZES[name],)
    assert env.action_spec.space.low.eq(-1).all()
    assert env.action_spec.space.high.eq(1).all()


@pytest.mark.gl
def test_every_paper_domain_renders_once_per_agent_step_and_stacks_its_frames(
    paper_env: tuple[str, EnvBase], monkeypatch: pytest.MonkeyPatch
) -> None:
    from dm_control.mujoco import engine

    images: list[torch.Tensor] = []
    render = engine.Camera.render

    def recording_render(*args: object, **kwargs: object) -> np.ndarray:
        image = render(*args, **kwargs)
        images.append(torch.from_numpy(image.transpose(2, 0, 1).copy()))
        return image

    monkeypatch.setattr(engine.Camera, "render", recording_render)
    _, env = paper_env
    rollout = play(env, 4)
    assert len(images) == 5
    assert rollout["pixels"].dtype == torch.uint8
    assert rollout["pixels"].shape == (4, 9, 84, 84)
    assert torch.equal(rollout["pixels"][0], torch.cat([images[0]] * 3))
    assert torch.equal(rollout["next", "pixels"][0], torch.cat([images[0], images[0], images[1]]))
    assert torch.equal(rollout["next", "pixels"][3], torch.cat(images[2:5]))
    assert not torch.equal(images[0], images[4])


@pytest.mark.gl
def test_every_paper_domain_plays_the_same_episode_for_the_same_seed(paper_env: tuple[str, EnvBase]) -> None:
    _, env = paper_env
    first = play(env, 2, seed=11)
    other = play(env, 2, seed=12)
    again = play(env, 2, seed=11)
    for key in ("pixels", ("next", "pixels"), ("next", "reward"), ("next", "qpos"), ("next", "qvel")):
        assert torch.equal(first[key], again[key]), key
    assert not torch.equal(first["pixels"], other["pixels"])


@pytest.mark.gl
@pytest.mark.parametrize("task", ["hopper_hop", "reach_duplo"])
def test_an_episode_depends_on_its_seed_and_not_on_the_environments_past(task: str) -> None:
    old, new = make_env(task, seed=1, frame_stack=1), make_env(task, seed=5, frame_stack=1)
    play(old, 3)
    seeded, fresh = play(old, 2, seed=5), play(new, 2)
    old.close()
    new.close()
    assert torch.equal(seeded["next", "pixels"], fresh["next", "pixels"])


@pytest.mark.gl
def test_suite_pixels_are_those_of_physics_render() -> None:
    env = make_env("quadruped_run", seed=0, frame_stack=1)
    for _ in range(2):  # the camera survives a reset
        last = play(env, 2)[-1]["next", "pixels"].permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(last, env.simulator._env.physics.render(84, 84, camera_id=2))
    env.close()


@pytest.mark.gl
def test_manipulation_pixels_and_rewards_are_those_of_the_tasks_own_front_close_observation() -> None:
    env = make_env("reach_duplo", seed=3, frame_stack=1)
    seen = play(env, 2)
    env.close()
    from dm_control import manipulation
    from dm_control.suite.wrappers import action_scale

    reference = manipulation.load("reach_duplo_vision", seed=3)
    scaled = action_scale.Wrapper(reference, -1.0, 1.0)
    first = scaled.reset().observation["front_close"][0]
    rewards = []
    for action in seen["action"].numpy():
        steps = [scaled.step(action) for _ in range(2)]
        rewards.append([np.float32(steps[0].reward + steps[1].reward)])
    last = steps[-1].observation["front_close"][0]
    reference.close()
    np.testing.assert_array_equal(seen["pixels"][0].permute(1, 2, 0).numpy(), first)
    np.testing.assert_array_equal(seen["next", "pixels"][-1].permute(1, 2, 0).numpy(), last)
    np.testing.assert_array_equal(seen["next", "reward"].numpy(), rewards)


@pytest.mark.gl
@pytest.mark.parametrize(("task", "shadow_size"), [("cheetah_run", 512), ("reach_duplo", 1024)])
def test_fast_quality_changes_few_pixels_and_is_recorded(task: str, shadow_size: int) -> None:
    images = {}
    for quality in ("exact", "fast"):
        env = make_env(task, seed=0, frame_stack=1, quality=quality)
        images[quality] = env.reset()["pixels"].int()
        assert env.card()["quality"] == quality
        size = env.simulator._env.physics.model.vis.quality.shadowsize
        assert size == shadow_size if quality == "fast" else size > shadow_size
        env.close()
    changed = (images["exact"] != images["fast"]).any(0).float().mean()
    assert changed < 0.01


@pytest.mark.gl
@pytest.mark.parametrize("task", ["walker_run", "quadruped_escape"])
def test_fast_quality_reaches_the_render_context(task: str) -> None:
    """quadruped_escape makes its context in the reset, to send its terrain to the GPU."""
    images = {}
    for quality in ("exact", "fast"):
        env = make_env(task, seed=0, frame_stack=1, quality=quality)
        images[quality] = env.reset()["pixels"].int()
        shadow_size = env.simulator._env.physics.contexts.mujoco.ptr.shadowSize
        assert shadow_size == 512 if quality == "fast" else shadow_size > 512
        env.close()
    changed = (images["exact"] != images["fast"]).any(0).float().mean()
    assert 0 < changed < (0.15 if task == "quadruped_escape" else 0.01)


@pytest.mark.gl
def test_other_sizes_stacks_repeats_and_cameras() -> None:
    env = make_env("cartpole_balance", seed=0, image_size=64, frame_stack=2, action_repeat=4, camera=1)
    td = env.rollout(2)
    assert td["next", "pixels"].shape == (2, 6, 64, 64)
    assert env.simulator._env.physics.time() == pytest.approx(2 * 4 * 0.01)
    card = env.card()
    assert (card["image_size"], card["action_repeat"], card["camera"]) == (64, 4, 1)
    assert card["backend"] in ("egl", "osmesa", "glfw")
    env.close()


@pytest.mark.gl
def test_images_larger_than_the_models_framebuffer_are_rendered() -> None:
    env = make_env("pendulum_swingup", seed=0, image_size=500, frame_stack=1, quality="fast")
    assert env.reset()["pixels"].shape == (3, 500, 500)
    env.close()


@pytest.mark.gl
def test_an_unknown_camera_answers_with_the_models_cameras() -> None:
    env = make_env("cheetah_run", seed=0, camera="sideways")
    with pytest.raises(CRPTproError, match=r"sideways.*side, back"):
        env.reset()
    env.close()


def test_episode_length_counts_agent_steps() -> None:
    assert episode_length("cheetah") == episode_length("dog_run") == 500
    assert episode_length("reach_duplo") == episode_length("manip_lift_brick") == 125
    assert episode_length("walker_walk", action_repeat=3) == 334
    assert episode_length("lqr_2_1") is None
    assert episode_length(Domain("own", "own")) is None
    assert episode_length("gymnasium:HalfCheetah-v5") == 500


@pytest.mark.parametrize(
    "option",
    [{"image_size": 0}, {"action_repeat": 0}, {"frame_stack": 0}, {"quality": "best"}, {"colors": "pink"}],
)
def test_impossible_options_are_refused_before_anything_is_loaded(option: dict[str, object]) -> None:
    with pytest.raises(CRPTproError, match=next(iter(option))):
        make_env("cheetah_run", seed=0, **option)  # type: ignore[arg-type]


def test_an_unknown_task_is_refused_with_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="walker_walk"):
        make_env("walker_wolk", seed=0)

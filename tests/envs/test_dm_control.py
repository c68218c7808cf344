from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import CatFrames, DMControlWrapper, EnvBase, check_env_specs

from crptpro.domains import PAPER_DOMAINS, SUITE_TASKS, Domain, get_domain
from crptpro.envs import make_env
from crptpro.envs.base import action_range
from crptpro.envs.dm_control import reverse_background
from crptpro.envs.rendering import select_backend
from crptpro.errors import EnvCrashedError, UnknownNameError

SEED = 11


def play(env: EnvBase, agent_steps: int) -> TensorDictBase:
    """A fixed sequence of actions from the next reset on."""
    generator, shape = torch.Generator().manual_seed(0), env.action_spec.shape
    return env.rollout(agent_steps, lambda td: td.set("action", 2 * torch.rand(shape, generator=generator) - 1))


@pytest.fixture(scope="module", params=PAPER_DOMAINS)
def played(request: pytest.FixtureRequest) -> Iterator[Any]:
    """An environment of a domain, an episode of which was played from ``SEED`` with its camera counted."""
    select_backend()
    from dm_control.mujoco import engine

    env, renders, render = make_env(request.param, seed=0, physics_state=True), [], engine.Camera.render
    first = play(env, 1)
    env.set_seed(SEED)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(engine.Camera, "render", lambda *a, **k: renders.append(1) or render(*a, **k))
        rollout = play(env, 3)
    yield SimpleNamespace(name=request.param, env=env, first=first, rollout=rollout, renders=len(renders))
    env.close()


def plain_dm_control(domain: Domain, seed: int) -> tuple[Any, Any]:
    """Load a domain without this library; returns the environment, and what its images are."""
    from dm_control import manipulation, suite

    if domain.source == "manipulation":
        env = manipulation.load("reach_duplo_vision", seed=seed)
        return env, lambda step: step.observation["front_close"][0]
    env = suite.load(domain.name, domain.task.removeprefix(f"{domain.name}_"), task_kwargs={"random": seed})
    return env, lambda _: env.physics.render(84, 84, camera_id=2 if domain.name == "quadruped" else 0)


@pytest.mark.gl
def test_every_paper_domain_gives_the_frames_and_rewards_of_plain_dm_control(played: Any) -> None:
    from dm_control.suite.wrappers import action_scale

    env, image_of = plain_dm_control(PAPER_DOMAINS[played.name], SEED)
    scaled = action_scale.Wrapper(env, -1.0, 1.0)
    step = scaled.reset()
    frames, rewards = [torch.from_numpy(image_of(step).transpose(2, 0, 1).copy())], []
    for action in played.rollout["action"].numpy():
        steps = [scaled.step(action) for _ in range(2)]
        frames.append(torch.from_numpy(image_of(steps[-1]).transpose(2, 0, 1).copy()))
        rewards.append([np.float32(steps[0].reward + steps[1].reward)])
    state = env.physics.data.qpos.copy()
    env.close()
    shown = [frames[0]] * 3 + frames[1:]
    for index, td in enumerate(played.rollout):
        assert torch.equal(td["pixels"], torch.cat(shown[index : index + 3]))
        assert torch.equal(td["next", "pixels"], torch.cat(shown[index + 1 : index + 4]))
    np.testing.assert_array_equal(played.rollout["next", "reward"].numpy(), rewards)
    np.testing.assert_array_equal(played.rollout["next", "qpos"][-1].numpy(), state)
    assert not torch.equal(frames[0], frames[-1])


@pytest.mark.gl
def test_every_paper_domain_is_drawn_once_per_agent_step_by_torchrls_parts(played: Any) -> None:
    assert played.renders == 1 + 3
    assert isinstance(played.env.base_env, DMControlWrapper)
    assert isinstance(played.env.transform[-1], CatFrames)
    assert played.rollout["next", "reward"].dtype == played.rollout["action"].dtype == torch.float32
    assert played.rollout["next", "qvel"].dtype == torch.float64
    assert played.env.action_spec.space.low.eq(-1).all()
    if played.name in ("cheetah", "manipulation"):
        check_env_specs(played.env)


@pytest.mark.gl
def test_an_episode_depends_on_its_seed(played: Any) -> None:
    played.env.set_seed(0)
    again = play(played.env, 1)
    for key in ("pixels", ("next", "pixels"), ("next", "reward"), ("next", "qpos"), ("next", "qvel")):
        assert torch.equal(again[key], played.first[key]), key
    assert not torch.equal(again["pixels"][0], played.rollout["pixels"][0])


@pytest.mark.gl
@pytest.mark.parametrize("task", ["walker_run", "quadruped_escape"])
def test_fast_quality_reaches_the_render_context_and_changes_few_pixels(task: str) -> None:
    """quadruped_escape makes its context in the reset, to send its terrain to the GPU."""
    images = {}
    for quality in ("exact", "fast"):
        env = make_env(task, seed=0, frame_stack=1, quality=quality)
        images[quality] = env.reset()["pixels"].int()
        size = env.physics.contexts.mujoco.ptr.shadowSize
        assert size == 512 if quality == "fast" else size > 512
        env.close()
    changed = (images["exact"] != images["fast"]).any(0).float().mean()
    assert 0 < changed < (0.15 if task == "quadruped_escape" else 0.01)


@pytest.mark.gl
@pytest.mark.parametrize("name", ["cheetah", "manipulation"])
def test_a_real_background_changes_its_colours_and_the_episode_stays_the_same(name: str) -> None:
    """Manipulation compiles a new model at every reset."""
    images, states = {}, {}
    for colors in ("normal", "reversed_background", "reversed_image"):
        env = make_env(name, seed=1, frame_stack=1, quality="fast", physics_state=True, colors=colors)
        env.reset()
        env.set_seed(1)
        seen = play(env, 1)
        images[colors], states[colors] = seen["next", "pixels"][-1].int(), seen["next", "qpos"]
        env.close()
    assert states["normal"].equal(states["reversed_background"])
    assert images["reversed_image"].equal(images["normal"].flip(0))
    # Most of a picture is background: there it is the same as the reversed picture. The robot is not.
    same = (images["reversed_background"] == images["reversed_image"]).all(0).float().mean()
    assert 0.7 < same < 1.0
    assert images["reversed_background"][1].equal(images["normal"][1]), "the middle channel keeps its place"


@pytest.mark.gl
def test_other_sizes_stacks_repeats_and_cameras() -> None:
    domain, settings = get_domain("cartpole_balance"), {"image_size": 500, "frame_stack": 2, "action_repeat": 4}
    shown = []
    for camera in (0, 1):
        env = make_env(replace(domain, camera=camera), seed=0, **settings)
        shown.append(env.rollout(2)["next", "pixels"])
        assert shown[-1].shape == (2, 6, 500, 500)
        assert env.physics.time() == pytest.approx(2 * 4 * 0.01)
        env.close()
    assert not shown[0].equal(shown[1])
    for camera, complaint in {"sideways": "'sideways' does not exist", 7: "camera_id=7 is invalid"}.items():
        env = make_env(replace(domain, camera=camera), seed=0)
        with pytest.raises(EnvCrashedError, match=rf"{complaint}.*'cartpole_balance'"):
            env.reset()
        env.close()


@pytest.mark.gl
@pytest.mark.parametrize(("task", "agent_steps"), [("pendulum", 500), ("reach_duplo", 125)])
def test_a_full_episode_is_truncated_and_not_terminated(task: str, agent_steps: int) -> None:
    env = make_env(task, seed=0, image_size=8, render=False)
    ends = env.rollout(agent_steps + 10)["next"]
    env.close()
    assert len(ends) == agent_steps
    assert ends["truncated"].sum() == ends["truncated"][-1] == 1
    assert not ends["terminated"].any()


@pytest.mark.gl
@pytest.mark.parametrize("task", [tasks[0] for tasks in SUITE_TASKS.values()])
def test_a_task_of_every_environment_of_the_suite_is_built_and_its_pixels_change(task: str) -> None:
    # Long agent steps, so that every environment moves visibly in one.
    env = make_env(task, seed=0, image_size=48, frame_stack=1, action_repeat=20, quality="fast")
    first = env.reset()
    last = env.step(first.clone().set("action", torch.ones(env.action_spec.shape)))["next"]
    env.close()
    assert first["pixels"].unique().numel() > 10
    assert not torch.equal(first["pixels"], last["pixels"])


@pytest.mark.gl
def test_a_task_of_the_suite_is_loaded_under_another_domains_name_and_an_unknown_one_is_refused() -> None:
    env = make_env(Domain("seen_from_behind", "acrobot_swingup", camera=0, source="suite"), seed=0, render=False)
    assert env.physics.model.name2id("upper_arm", "geom") >= 0
    env.close()
    with pytest.raises(UnknownNameError, match="acrobot_dance"):
        make_env(Domain("own", "acrobot_dance", source="suite"), seed=0)


@pytest.mark.parametrize("big", [np.inf, 3e38, 1e10])
def test_an_actuator_without_bounds_takes_the_action_as_it_is(big: float) -> None:
    start, half = action_range(np.array([-big, -1.0, 0.0]), np.array([big, 1.1, 4.0]), np.float64, "fake")
    np.testing.assert_allclose([start, start + half, start + 2 * half], [[-1, -1, 0], [0, 0.05, 2], [1, 1.1, 4]])


MODEL = """
<mujoco>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1=".1 .2 .4" width="4" height="24"/>
    <texture name="grid" type="2d" builtin="flat" rgb1=".8 .4 .2" width="4" height="4"/>
    <texture name="skin" type="2d" builtin="flat" rgb1=".2 .6 1" width="4" height="4"/>
    <texture name="shared" type="2d" builtin="flat" rgb1=".2 .4 .6" width="4" height="4"/>
    <material name="grid" texture="grid" rgba=".9 .6 .3 .5"/>
    <material name="skin" texture="skin" rgba=".1 .2 .3 1"/>
    <material name="shared" texture="shared" rgba=".1 .2 .3 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" material="grid"/>
    <geom name="wall" type="plane" size="1 1 1" rgba=".3 .2 .1 1"/>
    <geom name="striped" type="plane" size="1 1 1" material="shared"/>
    <geom name="rail" type="box" size="1 1 1" rgba=".3 .2 .1 1"/>
    <body>
      <joint type="hinge"/>
      <geom name="robot" type="sphere" size="1" material="skin" rgba=".7 .5 .3 1"/>
      <geom name="foot" type="sphere" size="1" material="shared"/>
    </body>
  </worldbody>
</mujoco>
"""


def texels(model: mujoco.MjModel, name: str) -> np.ndarray:
    texture = model.texture(name)
    size = int(texture.height[0] * texture.width[0] * 3)
    return model.tex_data[texture.adr[0] : texture.adr[0] + size].reshape(-1, 3).copy()


def test_skybox_and_floor_are_reversed_and_nothing_else() -> None:
    model, untouched = (mujoco.MjModel.from_xml_string(MODEL) for _ in range(2))
    reverse_background(model)
    for name in ("sky", "grid"):
        assert (texels(model, name) == texels(untouched, name)[:, ::-1]).all()
        assert (texels(model, name) != texels(untouched, name)).any()
    for name in ("skin", "shared"):
        assert (texels(model, name) == texels(untouched, name)).all()
        assert (model.material(name).rgba == untouched.material(name).rgba).all()
    np.testing.assert_allclose(model.material("grid").rgba, [0.3, 0.6, 0.9, 0.5], rtol=1e-6)
    np.testing.assert_allclose(model.geom("wall").rgba, [0.1, 0.2, 0.3, 1], rtol=1e-6)
    for name in ("rail", "robot", "foot"):
        assert (model.geom(name).rgba == untouched.geom(name).rgba).all()

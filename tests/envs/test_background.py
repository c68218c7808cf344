from __future__ import annotations

from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from fake_simulator import FakeDmEnv
from tensordict import TensorDict

from crptpro.domains import PAPER_DOMAINS, Domain
from crptpro.envs import make_env
from crptpro.envs.background import reverse_background
from crptpro.errors import CRPTproError

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


def constant_action(shape: torch.Size, td: TensorDict) -> TensorDict:
    return td.set("action", torch.full(shape, 0.5))


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
    np.testing.assert_allclose(model.material("grid").rgba, [0.3, 0.6, 0.9, 0.5], rtol=1e-6)
    np.testing.assert_allclose(model.geom("wall").rgba, [0.1, 0.2, 0.3, 1], rtol=1e-6)
    for name in ("skin", "shared"):
        assert (model.material(name).rgba == untouched.material(name).rgba).all()
    for name in ("rail", "robot", "foot"):
        assert (model.geom(name).rgba == untouched.geom(name).rgba).all()


def test_twice_gives_the_colours_back() -> None:
    model, untouched = (mujoco.MjModel.from_xml_string(MODEL) for _ in range(2))
    reverse_background(model)
    reverse_background(model)
    assert (model.tex_data == untouched.tex_data).all()
    assert (model.mat_rgba == untouched.mat_rgba).all()


def test_a_model_without_background_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='box' size='1 1 1'/></worldbody></mujoco>"
    )
    with pytest.raises(CRPTproError, match=r"no background.*reversed_image"):
        reverse_background(model)


@pytest.mark.parametrize("task", ["gymnasium:HalfCheetah-v5", Domain("own", "own", make=FakeDmEnv)])
def test_only_dm_control_worlds_have_a_known_background(task: str | Domain) -> None:
    with pytest.raises(CRPTproError, match=r"dm_control.*reversed_image"):
        make_env(task, seed=0, colors="reversed_background")


@pytest.mark.gl
@pytest.mark.parametrize(
    "name",
    [
        "cheetah",
        # The first makes its render context in the reset, manipulation compiles a new model at every reset.
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("quadruped_escape", *PAPER_DOMAINS)
            if name != "cheetah"
        ),
    ],
)
def test_a_real_background_changes_its_colours_and_the_episode_stays_the_same(name: str) -> None:
    images, states = {}, {}
    for colors in ("normal", "reversed_background", "reversed_image"):
        env = make_env(name, seed=0, frame_stack=1, quality="fast", physics_state=True, colors=colors)
        env.reset()
        env.set_seed(1)
        seen = env.rollout(2, partial(constant_action, env.action_spec.shape))
        images[colors], states[colors] = seen["next", "pixels"][-1].int(), seen["next", "qpos"]
        assert env.card()["colors"] == colors
        env.close()
    assert states["normal"].equal(states["reversed_background"])
    assert images["reversed_image"].equal(images["normal"].flip(0))
    # Most of a picture is background: there it is the same as the reversed picture. The robot is not.
    same = (images["reversed_background"] == images["reversed_image"]).all(0).float().mean()
    assert 0.7 < same < 1.0
    # The middle channel keeps its place.
    assert images["reversed_background"][1].equal(images["normal"][1])

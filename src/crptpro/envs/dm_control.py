"""dm_control environments: TorchRL's ``DMControlWrapper`` around one step per agent step and one persistent camera."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from typing import Any

import dm_env
import numpy as np
import torch
from dm_env import specs
from torch import Tensor
from torchrl.envs.libs.dm_control import DMControlWrapper

from crptpro.domains import Domain
from crptpro.envs.rendering import first_frame_watchdog, render_context
from crptpro.envs.worlds import ActionRange, CheckedWorld, FrameReader, passed_on
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.values import Quality

logger = logging.getLogger(__name__)

#: Side of the shadow map in texels for ``quality="fast"``; the models have 2048 (suite) and 4096 (manipulation).
FAST_SHADOW_SIZE = {"suite": 512, "manipulation": 1024}


def make_dm_control(domain: Domain, *, quality: Quality, **settings: Any) -> DMControlPixelEnv:
    """Build an environment of the suite or of manipulation; the settings are those of :class:`AgentSteps`."""
    shadow_size = FAST_SHADOW_SIZE[domain.source] if quality == "fast" else None
    with first_frame_watchdog(), render_context(None):  # composer renders once when it is built
        env = load_dm_env(domain)
    return DMControlPixelEnv(AgentSteps(env, world=domain.task, shadow_size=shadow_size, **settings))


def load_dm_env(domain: Domain) -> dm_env.Environment:
    """Load ``domain.task`` from dm_control with a constant seed, without the camera observations of composer tasks."""
    from dm_control import manipulation, suite

    route_mujoco_warnings()
    if domain.source == "manipulation":
        env = manipulation.load(f"{domain.task}_vision", seed=0)
        # The built-in camera would render at every env step.
        for observable in env.task.observables.values():
            observable.enabled = False
        return env
    # In the suite, lqr_2_1 is the task lqr_2_1 of the domain lqr.
    tasks = {f"{world}_{task.removeprefix(f'{world}_')}": (world, task) for world, task in suite.ALL_TASKS}
    if domain.task not in tasks:
        raise UnknownNameError(f"Domain {domain.name!r} has the task {domain.task!r}, which the suite lacks.")
    return suite.load(*tasks[domain.task], task_kwargs={"random": 0})


def route_mujoco_warnings() -> None:
    """Log MuJoCo's warnings, deprecations at debug level; call it after importing dm_control, which uses absl.

    Without a handler MuJoCo prints them and appends to ``MUJOCO_LOG.TXT`` in the working directory.
    """
    import mujoco

    def log(message: str | bytes) -> None:
        text = message.decode(errors="replace") if isinstance(message, bytes) else str(message)
        logger.log(logging.DEBUG if "deprecated" in text else logging.WARNING, "MuJoCo: %s", text)

    mujoco.set_mju_user_warning(log)


def reverse_background(model: Any) -> None:
    """Reverse the RGB values of the background of a ``mujoco.MjModel`` in place, before its render context is made.

    The paper does not define the background. Here it is the skybox, and the planes and height fields that are fixed to
    the world (floor, walls, terrain): their textures, materials and geoms. Materials and textures that something else
    uses too keep their colours. A model without a background is a ``CRPTproError``.
    """
    import mujoco

    sheets = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    is_fixed = model.body_weldid[model.geom_bodyid] == 0
    is_background = is_fixed & np.isin(model.geom_type, [int(kind) for kind in sheets])
    materials = np.setdiff1d(model.geom_matid[is_background], [*model.geom_matid[~is_background], -1])
    others = np.setdiff1d(np.arange(model.nmat), materials)
    roles = [int(mujoco.mjtTextureRole.mjTEXROLE_RGB), int(mujoco.mjtTextureRole.mjTEXROLE_RGBA)]
    textures = np.setdiff1d(model.mat_texid[materials][:, roles], model.mat_texid[others])
    skyboxes = np.flatnonzero(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX))
    textures = np.union1d(textures[textures >= 0], skyboxes)
    if not (textures.size or is_background.any()):
        raise CRPTproError(
            "This model has no background whose colours could be reversed: no skybox, and no plane or height field "
            "that is fixed to the world. colors='reversed_image' works everywhere."
        )
    for texture in textures:
        first, channels = model.tex_adr[texture], model.tex_nchannel[texture]
        size = model.tex_height[texture] * model.tex_width[texture] * channels
        if channels >= 3:
            texels = model.tex_data[first : first + size].reshape(-1, channels)
            texels[:, :3] = texels[:, 2::-1].copy()
    model.mat_rgba[materials, :3] = model.mat_rgba[materials, 2::-1]
    model.geom_rgba[is_background, :3] = model.geom_rgba[is_background, 2::-1]


class AgentSteps(dm_env.Environment):
    """A dm_control environment in agent steps: actions repeated and scaled, rewards summed, one frame rendered.

    TorchRL's ``from_pixels`` calls ``physics.render``, which builds a camera and its scene for every image. This camera
    is rebuilt only with the model (in composer environments at every reset), and gives the same pixels in 7 to 16 %
    less time for cheetah or walker (software GL; no gain on manipulation).

    The settings are those of :func:`crptpro.envs.make_env`; ``shadow_size`` is the side of the shadow map in texels.
    """

    def __init__(
        self,
        env: dm_env.Environment,
        *,
        world: str,
        image_size: int,
        action_repeat: int,
        camera: Any = 0,
        render: bool = True,
        physics_state: bool = False,
        shadow_size: int | None = None,
        reverses_background: bool = False,
    ):
        self.env, self.physics_state = env, physics_state
        self._world, self._action_repeat = world, action_repeat
        self._image_size, self._camera_id, self._renders = image_size, camera, render
        self._shadow_size, self._reverses_background = shadow_size, reverses_background
        self._image_shape = (3, image_size, image_size)
        self._read_frame = FrameReader(world)
        self._camera: Any = None
        self._model: Any = None
        self._prepared: Any = None
        spec = env.action_spec()
        low, high = (np.broadcast_to(bound, spec.shape) for bound in (spec.minimum, spec.maximum))
        self._to_actuators = ActionRange(low, high, spec.dtype, world)
        if render:
            self._prepare()  # quadruped_escape makes the render context in its reset

    @property
    def physics(self) -> Any:
        """State and model of the simulation; composer environments make a new one at every reset."""
        return self.env.physics

    def seed(self, seed: int) -> None:
        """Re-seed the generator that the task draws from, without resetting."""
        generator = getattr(self.env, "random_state", None)
        (self.env.task.random if generator is None else generator).seed(seed)

    def reset(self) -> dm_env.TimeStep:
        is_same = self._camera is not None and self.physics.model is self._model
        with render_context(self._make_current if is_same else None):  # quadruped_escape uploads its terrain
            self.env.reset()
        return dm_env.restart(self._observe())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Repeat an action in [-1, 1]; the reward is the sum."""
        command = self._to_actuators(action)
        reward = 0.0
        for _ in range(self._action_repeat):
            last = self.env.step(command)
            reward += last.reward or 0.0
            if last.last():
                break
        return dm_env.TimeStep(last.step_type, reward, last.discount, self._observe())

    def _observe(self) -> dict[str, Any]:
        observation = {"pixels": self._draw()}
        if self.physics_state:
            data = self.physics.data
            observation |= {"qpos": torch.tensor(data.qpos), "qvel": torch.tensor(data.qvel)}
        return observation

    def _draw(self) -> Tensor:
        if not self._renders:
            return torch.zeros(self._image_shape, dtype=torch.uint8)
        is_first = self.physics.model is not self._model
        with passed_on(self._world, "render"), first_frame_watchdog() if is_first else nullcontext():
            if is_first:
                self._prepare()  # a composer environment has compiled a new model
            with render_context(self._make_current):
                if is_first:
                    self._build_camera()
                return self._read_frame(self._camera.render())

    def _make_current(self) -> None:
        context = self.physics.contexts.gl
        with context.make_current() as thread:
            thread.call(context._platform_make_current)  # dm_control ignores the contexts of other libraries

    def _prepare(self) -> None:
        """Set what a render context reads only when it is made."""
        model = self.physics.model
        if model.ptr is self._prepared:
            return
        self._prepared = model.ptr
        visual = model.vis
        if self._shadow_size is not None:
            visual.quality.shadowsize = min(self._shadow_size, visual.quality.shadowsize)
        visual.global_.offwidth = max(self._image_size, visual.global_.offwidth)
        visual.global_.offheight = max(self._image_size, visual.global_.offheight)
        if self._reverses_background:
            reverse_background(model.ptr)

    def _build_camera(self) -> None:
        from dm_control.mujoco.engine import Camera

        model = self.physics.model
        names = [model.id2name(index, "camera") or str(index) for index in range(model.ncam)]
        if self._camera_id not in (*names, *range(-1, model.ncam)):
            raise CRPTproError(
                f"This model has no camera {self._camera_id!r}. It has {', '.join(names) or 'none'}, or 0 to "
                f"{model.ncam - 1}; -1 is the free camera."
            )
        self._camera = Camera(self.physics, self._image_size, self._image_size, camera_id=self._camera_id)
        self._model = model

    def observation_spec(self) -> dict[str, specs.Array]:
        found = {"pixels": specs.BoundedArray(self._image_shape, np.uint8, 0, 255)}
        if self.physics_state:
            model = self.physics.model
            found |= {"qpos": specs.Array((model.nq,), float), "qvel": specs.Array((model.nv,), float)}
        return found

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray(self.env.action_spec().shape, np.float32, -1.0, 1.0)

    def reward_spec(self) -> specs.Array:
        return specs.Array((), np.float32)

    def close(self) -> None:
        self._camera = self._model = None
        self.physics.free()
        self.env.close()


class DMControlPixelEnv(CheckedWorld, DMControlWrapper):
    """TorchRL's ``DMControlWrapper`` around :class:`AgentSteps`.

    ``DMControlEnv(from_pixels=True)`` always renders 240 x 320, refuses composer tasks (manipulation), and renders
    every env step of a repeated action, which doubles the time of an agent step.
    """

    def _check_kwargs(self, kwargs: dict[str, Any]) -> None:
        pass  # TorchRL's refuses composer environments

    def _build_env(self, env: AgentSteps, **kwargs: Any) -> AgentSteps:
        self.from_pixels = self.pixels_only = True
        return env

    def _init_env(self, seed: int | None = None) -> int | None:
        return seed  # TorchRL's resets here

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._env.seed(seed)

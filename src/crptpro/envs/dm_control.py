"""dm_control worlds as TorchRL environments: ``DMControlWrapper`` over one step per decision and one kept camera."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import dm_env
import numpy as np
import torch
from dm_env import specs
from torch import Tensor
from torchrl.envs.libs.dm_control import DMControlWrapper

from crptpro.domains import SUITE_TASKS, Domain
from crptpro.envs.rendering import first_frame_watchdog, own_context
from crptpro.envs.worlds import ActionRange, CheckedWorld, FrameReader, passed_on
from crptpro.errors import CRPTproError, UnknownNameError

logger = logging.getLogger(__name__)

#: Side of the shadow map, texels, that ``quality="fast"`` uses instead of the model's own 2048 (suite) or
#: 4096 (manipulation). On software GL the shadow map is half the cost of a frame; fewer than 1 % of pixels
#: change (8 % on the terrain of quadruped_escape, which is all shadows).
FAST_SHADOW_SIZE = {"suite": 512, "manipulation": 1024}


def load_dm_env(domain: Domain) -> dm_env.Environment:
    """Load ``domain.task`` from dm_control, with all camera observations of composer tasks switched off.

    The model does not depend on any seed (LQR draws its own from a fixed one), so that an episode depends on
    nothing but the seed given before its reset.
    """
    if domain.source == "manipulation":
        from dm_control import manipulation

        route_mujoco_warnings()
        env = manipulation.load(f"{domain.task}_vision", seed=0)
        # The built-in camera renders at every env step, twice per agent step; SceneCamera replaces it. The
        # switch takes effect at the first reset, which compiles the model anew.
        for observable in env.task.observables.values():
            observable.enabled = False
        return env
    from dm_control import suite

    route_mujoco_warnings()
    world = next((world for world, tasks in SUITE_TASKS.items() if domain.task in tasks), None)
    if world is None:
        raise UnknownNameError(f"Domain {domain.name!r} has the task {domain.task!r}, which the suite lacks.")
    name = domain.task.removeprefix(f"{world}_")
    if (world, name) not in suite.ALL_TASKS:
        name = domain.task  # lqr_2_1 is a task of the domain lqr under its full name
    return suite.load(world, name, task_kwargs={"random": 0})


def route_mujoco_warnings() -> None:
    """Log MuJoCo's warnings; call it after importing dm_control, which sends them to absl.

    Without a handler MuJoCo prints them and appends to ``MUJOCO_LOG.TXT`` in the working directory.
    Deprecations concern the authors of a model, not its users, and are logged at debug level.
    """
    import mujoco

    def log(message: str | bytes) -> None:
        text = message.decode(errors="replace") if isinstance(message, bytes) else str(message)
        logger.log(logging.DEBUG if "deprecated" in text else logging.WARNING, "MuJoCo: %s", text)

    mujoco.set_mju_user_warning(log)


class SceneCamera:
    """One dm_control ``Camera`` kept over steps and resets.

    ``physics.render``, which TorchRL's ``from_pixels`` and dm_control's ``pixels.Wrapper`` call, builds and frees a
    camera and its scene for every image; this one is rebuilt only when the model changes, as composer environments do
    at every reset. The pixels are identical. A frame of cheetah or walker takes 7 to 16 % less (software GL; nothing is
    gained on manipulation), more than the 5 % for which this library keeps something of its own.

    Args:
        image_size: H = W, pixels.
        camera: Index or name of a camera of the model, -1 for the free camera.
        shadow_size: Side of the shadow map, texels; ``None`` keeps the model's.
        reverses_background: Draw the background with its colours reversed.
    """

    def __init__(
        self,
        image_size: int,
        camera: int | str,
        shadow_size: int | None = None,
        *,
        reverses_background: bool = False,
    ):
        self._image_size = image_size
        self._camera_id = camera
        self._shadow_size = shadow_size
        self._reverses_background = reverses_background
        self._reversed_model: Any = None
        self._model: Any = None
        self._camera: Any = None

    def prepare(self, physics: Any) -> None:
        """Set what a render context reads once, when it is made; call it before the first reset.

        Some tasks (quadruped_escape, for its terrain) make the context while they start an episode.
        """
        visual = physics.model.vis
        if self._shadow_size is not None:
            visual.quality.shadowsize = min(self._shadow_size, visual.quality.shadowsize)
        visual.global_.offwidth = max(self._image_size, visual.global_.offwidth)
        visual.global_.offheight = max(self._image_size, visual.global_.offheight)
        if self._reverses_background and physics.model.ptr is not self._reversed_model:
            reverse_background(physics.model.ptr)
            self._reversed_model = physics.model.ptr

    def render(self, physics: Any) -> np.ndarray:
        """Return the image, uint8 ``[H, W, 3]``, in a buffer that the next call overwrites."""
        if physics.model is self._model:
            with self.own_context(physics):
                return self._camera.render()
        with first_frame_watchdog(), self.own_context(physics):
            self._build(physics)
            return self._camera.render()

    def own_context(self, physics: Any) -> AbstractContextManager[None]:
        """Draw, or change what is drawn, in the body into the context of the physics, if it has one already."""
        if physics.model is not self._model:
            return own_context(None)
        context = physics.contexts.gl

        def make_current() -> None:
            with context.make_current() as thread:
                thread.call(context._platform_make_current)  # dm_control knows of no context but its own

        return own_context(make_current)

    def release(self) -> None:
        """Drop the scene; the render context belongs to the physics."""
        self._camera = self._model = None

    def _build(self, physics: Any) -> None:
        from dm_control.mujoco.engine import Camera

        self.prepare(physics)  # a composer environment has compiled a new model since
        model = physics.model
        names = [model.id2name(index, "camera") or str(index) for index in range(model.ncam)]
        if self._camera_id not in (*names, *range(-1, model.ncam)):
            raise CRPTproError(
                f"This model has no camera {self._camera_id!r}. It has {', '.join(names) or 'none'}, or 0 to "
                f"{model.ncam - 1}; -1 is the free camera."
            )
        self._camera = Camera(physics, self._image_size, self._image_size, camera_id=self._camera_id)
        self._model = model


def reverse_background(model: Any) -> None:
    """Reverse the order of the red, green and blue values of a model's background, in place.

    The paper tests unseen colours by reversing the RGB values of the background, without saying what that is. Here it
    is the skybox, and the planes and height fields that are fixed to the world (floor, walls, terrain): their textures,
    and the colours of the materials and geoms that tint them. A material or texture that something else wears too
    keeps its colours: everything that moves looks as before.

    Call it before the render context is made, which is when textures are copied to it, and once per compiled model:
    twice restores the colours.

    Args:
        model: ``mujoco.MjModel``, 3.2 or later.

    Raises:
        CRPTproError: if the model has no background to reverse.
    """
    import mujoco

    sheets = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    is_fixed = model.body_weldid[model.geom_bodyid] == 0
    is_background = is_fixed & np.isin(model.geom_type, [int(kind) for kind in sheets])
    materials = np.setdiff1d(model.geom_matid[is_background], [*model.geom_matid[~is_background], -1])
    worn_by_others = np.setdiff1d(np.arange(model.nmat), materials)
    roles = [int(mujoco.mjtTextureRole.mjTEXROLE_RGB), int(mujoco.mjtTextureRole.mjTEXROLE_RGBA)]
    textures = np.setdiff1d(model.mat_texid[materials][:, roles], model.mat_texid[worn_by_others])
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
    """A dm_control world of which one step is one decision: repeated, summed, scaled, and drawn once.

    Args:
        env: With ``physics`` and either ``task.random`` (suite) or ``random_state`` (composer).
        camera: Draws the images; ``None`` leaves them black.
        world: Name for messages.
        image_size: H = W, pixels.
        action_repeat: Env steps per step, fewer where the episode ends.
        physics_state: Also observe ``qpos`` and ``qvel``.
    """

    def __init__(
        self,
        env: dm_env.Environment,
        camera: SceneCamera | None,
        *,
        world: str,
        image_size: int,
        action_repeat: int,
        physics_state: bool,
    ):
        self.env, self.physics_state = env, physics_state
        self._camera, self._world, self._action_repeat = camera, world, action_repeat
        self._read_frame, self._image_shape = FrameReader(world), (3, image_size, image_size)
        spec = env.action_spec()
        low, high = (np.broadcast_to(bound, spec.shape) for bound in (spec.minimum, spec.maximum))
        self._to_actuators = ActionRange(low, high, spec.dtype, world)

    @property
    def physics(self) -> Any:
        """The simulation's state and model; composer environments make a new one at every reset."""
        return self.env.physics

    def seed(self, seed: int) -> None:
        """Re-seed the generator that the task draws from, without resetting."""
        generator = getattr(self.env, "random_state", None)
        (self.env.task.random if generator is None else generator).seed(seed)

    def reset(self) -> dm_env.TimeStep:
        """Start an episode."""
        # Some tasks send what they drew (quadruped_escape: its terrain) to the render context.
        with nullcontext() if self._camera is None else self._camera.own_context(self.physics):
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

    def draw(self) -> Tensor:
        """Return the frame of the current state, uint8 ``[3, H, W]``."""
        if self._camera is None:
            return torch.zeros(self._image_shape, dtype=torch.uint8)
        with passed_on(self._world, "render"):
            return self._read_frame(self._camera.render(self.physics))

    def _observe(self) -> dict[str, Any]:
        observation = {"pixels": self.draw()}
        if self.physics_state:
            data = self.physics.data
            observation |= {"qpos": torch.tensor(data.qpos), "qvel": torch.tensor(data.qvel)}
        return observation

    def observation_spec(self) -> dict[str, specs.Array]:
        """Describe the frame and the physical state."""
        found = {"pixels": specs.BoundedArray(self._image_shape, np.uint8, 0, 255)}
        if self.physics_state:
            model = self.physics.model
            found |= {
                "qpos": specs.Array((model.nq,), np.float64),
                "qvel": specs.Array((model.nv,), np.float64),
            }
        return found

    def action_spec(self) -> specs.BoundedArray:
        """Describe actions, float32 in [-1, 1]."""
        return specs.BoundedArray(self.env.action_spec().shape, np.float32, -1.0, 1.0)

    def reward_spec(self) -> specs.Array:
        """Describe the summed reward."""
        return specs.Array((), np.float32)

    def close(self) -> None:
        """Free the physics and its render context."""
        if self._camera is not None:
            self._camera.release()
        self.physics.free()
        self.env.close()


class DMControlPixelEnv(CheckedWorld, DMControlWrapper):
    """TorchRL's ``DMControlWrapper`` with what it cannot do by itself.

    ``DMControlEnv(from_pixels=True)`` draws 240 x 320 whatever is asked for, refuses composer tasks (manipulation),
    and draws every env step of a repeated action, which doubles the time of an agent step. Here the repeat lies below
    the camera (:class:`AgentSteps`), actions and rewards are float32, and a seed does not reset the world.
    """

    def _check_kwargs(self, kwargs: dict[str, Any]) -> None:
        if not isinstance(kwargs["env"], dm_env.Environment):
            raise TypeError(f"env must be a dm_env.Environment, got {type(kwargs['env']).__name__}.")

    def _build_env(self, env: AgentSteps, **kwargs: Any) -> AgentSteps:
        self.from_pixels = self.pixels_only = True
        return env

    def _init_env(self, seed: int | None = None) -> int | None:
        return seed  # TorchRL's resets here

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._env.seed(seed)

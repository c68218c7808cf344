"""dm_control environments: TorchRL's ``DMControlWrapper`` with one persistent camera."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import dm_env
import numpy as np
from tensordict import TensorDictBase
from torchrl.envs.libs.dm_control import DMControlWrapper

from crptpro.domains import Domain
from crptpro.envs.base import SimulatorEnv
from crptpro.envs.rendering import render_context
from crptpro.errors import UnknownNameError
from crptpro.values import Quality

logger = logging.getLogger(__name__)

#: Side of the shadow map in texels for ``quality="fast"``; the models have 2048 (suite) and 4096 (manipulation).
FAST_SHADOW_SIZE = {"suite": 512, "manipulation": 1024}


def make_dm_control(domain: Domain, *, quality: Quality, **settings: Any) -> DMControlPixelEnv:
    """Build an environment of the suite or of manipulation; the settings are those of :class:`DMControlPixelEnv`."""
    shadow_size = FAST_SHADOW_SIZE[domain.source] if quality == "fast" else None
    with render_context(None, is_first=True):  # composer renders once when it is built
        env = load_dm_env(domain)
    return DMControlPixelEnv(env, name=domain.task, shadow_size=shadow_size, **settings)


def load_dm_env(domain: Domain) -> dm_env.Environment:
    """Load ``domain.task`` from dm_control with a constant seed, without the camera observations of composer tasks."""
    from dm_control import suite

    with warnings.catch_warnings():  # its import makes every later DeprecationWarning visible
        from dm_control import manipulation
    route_mujoco_warnings()
    if domain.source == "manipulation":
        env = manipulation.load(f"{domain.task}_vision", seed=0)
        # The built-in camera would render at every env step.
        for observable in env.task.observables.values():
            observable.enabled = False
        return env
    # In the suite, lqr_2_1 is the task lqr_2_1 of the domain lqr.
    tasks = {f"{name}_{task.removeprefix(f'{name}_')}": (name, task) for name, task in suite.ALL_TASKS}
    if domain.task not in tasks:
        raise UnknownNameError(f"Domain {domain.name!r} has the task {domain.task!r}, which the suite does not have.")
    return suite.load(*tasks[domain.task], task_kwargs={"random": 0})


def route_mujoco_warnings() -> None:
    """Log MuJoCo's warnings, instead of printing and writing them to a file; call it after importing dm_control."""
    import mujoco

    def log(message: str | bytes) -> None:
        text = message.decode(errors="replace") if isinstance(message, bytes) else str(message)
        logger.log(logging.DEBUG if "deprecated" in text else logging.WARNING, "MuJoCo: %s", text)

    mujoco.set_mju_user_warning(log)


def reverse_background(model: Any) -> None:
    """Reverse the RGB values of the background of a ``mujoco.MjModel`` in place, before its render context is made.

    The paper does not define the background. Here it is the skybox, and the planes and height fields that are fixed to
    the world (floor, walls, terrain), except for materials and textures that something else uses too.
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
    for texture in textures:
        first, channels = model.tex_adr[texture], model.tex_nchannel[texture]
        size = model.tex_height[texture] * model.tex_width[texture] * channels
        if channels >= 3:
            texels = model.tex_data[first : first + size].reshape(-1, channels)
            texels[:, :3] = texels[:, 2::-1].copy()
    model.mat_rgba[materials, :3] = model.mat_rgba[materials, 2::-1]
    model.geom_rgba[is_background, :3] = model.geom_rgba[is_background, 2::-1]


class DMControlPixelEnv(SimulatorEnv, DMControlWrapper):
    """TorchRL's ``DMControlWrapper`` with one persistent camera.

    ``DMControlEnv(from_pixels=True)`` always renders 240 x 320, refuses composer tasks (manipulation), and builds a
    camera and its scene for every image. This camera is rebuilt only with the model (in composer environments at every
    reset), and gives the same pixels in 7 to 16 % less time for cheetah or walker (software GL; no gain on
    manipulation). ``shadow_size`` is the side of the shadow map in texels.
    """

    def __init__(
        self,
        env: Any,
        *,
        name: str,
        camera: Any = 0,
        shadow_size: int | None = None,
        reverses_background: bool = False,
        **settings: Any,
    ):
        self._camera_id, self._shadow_size, self._reverses_background = camera, shadow_size, reverses_background
        self._camera: Any = None
        self._model: Any = None
        spec = env.action_spec()
        low, high = (np.broadcast_to(bound, spec.shape) for bound in (spec.minimum, spec.maximum))
        super().__init__(env, name=name, low=low, high=high, dtype=spec.dtype, **settings)

    def _check_kwargs(self, kwargs: dict[str, Any]) -> None:
        pass  # TorchRL's refuses composer environments

    def _init_env(self) -> None:  # TorchRL's resets here
        if self._renders:
            self._prepare()  # quadruped_escape makes the render context in its reset

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            return
        generator = getattr(self._env, "random_state", None)
        (self._env.task.random if generator is None else generator).seed(seed)

    def _simulation(self) -> Any:
        return self._env.physics.data

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        is_first = self._camera is None or self._env.physics.model is not self._model
        with render_context(None if is_first else self._make_current):  # quadruped_escape uploads its terrain
            return super()._reset(tensordict)

    def _render(self) -> np.ndarray:
        if self._env.physics.model is not self._model:
            self._prepare()  # a composer environment has compiled a new model
        with render_context(self._make_current, is_first=self._camera is None):
            if self._camera is None:
                self._build_camera()
            return self._camera.render()

    def _make_current(self) -> None:
        context = self._env.physics.contexts.gl
        with context.make_current() as thread:
            thread.call(context._platform_make_current)  # dm_control ignores the contexts of other libraries

    def _prepare(self) -> None:
        """Set the model options that a render context reads only at its creation."""
        self._camera, self._model = None, self._env.physics.model
        visual = self._model.vis
        if self._shadow_size is not None:
            visual.quality.shadowsize = min(self._shadow_size, visual.quality.shadowsize)
        visual.global_.offwidth = max(self._image_size, visual.global_.offwidth)
        visual.global_.offheight = max(self._image_size, visual.global_.offheight)
        if self._reverses_background:
            reverse_background(self._model.ptr)

    def _build_camera(self) -> None:
        from dm_control.mujoco.engine import Camera

        self._camera = Camera(self._env.physics, self._image_size, self._image_size, camera_id=self._camera_id)

    def close(self, *, raise_if_closed: bool = True) -> None:
        if not self.is_closed:
            self._camera = self._model = None
            self._env.physics.free()
        super().close()

"""Gymnasium environments that render RGB: TorchRL's ``GymWrapper``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from tensordict import TensorDictBase
from torchrl.envs.libs.gym import GymWrapper

from crptpro.domains import GYMNASIUM_PREFIX
from crptpro.envs.base import NO_BOUND, SimulatorEnv, passed_on
from crptpro.envs.dm_control import FAST_SHADOW_SIZE, route_mujoco_warnings
from crptpro.envs.rendering import render_context
from crptpro.errors import CRPTproError, RenderingError
from crptpro.values import Quality


class GymnasiumPixelEnv(SimulatorEnv, GymWrapper):
    """TorchRL's ``GymWrapper``; ``set_seed`` takes effect at the next reset, because Gymnasium seeds only there.

    Gymnasium's wrappers need OpenCV (``ResizeObservation``) or render every env step (``AddRenderObservation``).
    """

    _episode_seed: int | None = None
    _has_drawn = False

    def __init__(self, env: Any, *, name: str, **settings: Any):
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise CRPTproError(
                f"{name} has {type(space).__name__} actions. Only continuous actions (a Box) are supported; wrap it, "
                "and register it with register_domain."
            )
        if (np.minimum(np.abs(space.low), np.abs(space.high)) >= NO_BOUND).any():
            raise CRPTproError(
                f"{name} has actions without bounds ({space}), which cannot be mapped from [-1, 1]; wrap it with "
                "gymnasium.wrappers.RescaleAction or ClipAction, and register it with register_domain."
            )
        super().__init__(env, name=name, low=space.low, high=space.high, dtype=space.dtype, **settings)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._episode_seed = seed

    def _simulation(self) -> Any:
        return getattr(self._env.unwrapped, "data", None)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        seed, self._episode_seed = self._episode_seed, None
        return super()._reset(tensordict, seed=seed)

    def _reset_output_transform(self, reset_data: Any) -> tuple[Any, dict[str, Any]]:
        return reset_data, {}

    def _output_transform(self, step_outputs_tuple: Any) -> tuple[Any, ...]:
        observation, reward, terminated, truncated, _ = step_outputs_tuple
        # A time limit that coincides with a termination counts as a termination.
        ends = bool(terminated), bool(truncated and not terminated), bool(terminated or truncated)
        return (observation, float(reward), *ends, {})

    def _render(self) -> Any:
        viewer = getattr(getattr(self._env.unwrapped, "mujoco_renderer", None), "viewer", None)
        with render_context(getattr(viewer, "make_context_current", None), is_first=not self._has_drawn):
            try:
                image = self._env.render()
            except (ImportError, gymnasium.error.Error) as reason:
                raise RenderingError(f"{self._name} does not render: {reason}") from reason
        self._has_drawn = True
        return image


def make_gymnasium(
    task: str, *, camera: int | str | None, quality: Quality, image_size: int, **settings: Any
) -> GymnasiumPixelEnv:
    """Build ``gymnasium:<id>``; the settings are those of :func:`crptpro.envs.make_env`.

    Gymnasium's MuJoCo environments render at twice ``image_size``, others at their own size; images are resized.
    """
    env_id = task.removeprefix(GYMNASIUM_PREFIX)
    options: dict[str, Any] = {}
    if camera is not None:
        options["camera_name" if isinstance(camera, str) else "camera_id"] = camera
    if str(gymnasium.spec(env_id).entry_point).startswith("gymnasium.envs.mujoco"):
        # The default of 480 x 480 takes twice the time on software GL.
        options.update(width=2 * image_size, height=2 * image_size)
        route_mujoco_warnings()
    with passed_on(task, "make"):
        try:
            env: Any = gymnasium.make(env_id, render_mode="rgb_array", disable_env_checker=True, **options)
        except TypeError as reason:
            if not any(f"unexpected keyword argument '{option}'" in str(reason) for option in options):
                raise  # from the environment's code
            raise CRPTproError(f"{task} cannot be made with rgb_array rendering: {reason}.") from reason
        except (ImportError, gymnasium.error.Error) as reason:
            raise CRPTproError(f"{task} cannot be made: {reason}") from reason
    model: Any = getattr(env.unwrapped, "model", None)
    if camera is not None and hasattr(model, "ncam"):
        names = [model.camera(index).name for index in range(model.ncam)]
        if camera not in (*names, *range(-1, len(names))):
            env.close()  # MuJoCo would end the process for a wrong number, and show the free camera for a wrong name
            raise CRPTproError(f"{task} has no camera {camera!r}; its model has {len(names)}, from 0 on: {names}.")
    _fix_free_camera(env)
    if quality == "fast" and hasattr(model, "vis"):
        model.vis.quality.shadowsize = min(FAST_SHADOW_SIZE["suite"], model.vis.quality.shadowsize)
    return GymnasiumPixelEnv(env, name=task, image_size=image_size, **settings)


def _fix_free_camera(env: Any) -> None:
    """Point the free camera at the model's default pose, not the first rendered state, which differs after a resume."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    config = getattr(renderer, "default_cam_config", None) or {}
    if renderer is None or "lookat" in config:
        return
    import mujoco

    model = env.unwrapped.model
    pose = mujoco.MjData(model)
    mujoco.mj_forward(model, pose)
    renderer.default_cam_config = {**config, "lookat": np.median(pose.geom_xpos, axis=0)}

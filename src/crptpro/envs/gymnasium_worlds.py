"""Gymnasium environments that render RGB: TorchRL's ``GymWrapper`` around one step per agent step."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import Tensor
from torchrl.envs.libs.gym import GymWrapper

from crptpro.domains import GYMNASIUM_PREFIX
from crptpro.envs.dm_control import FAST_SHADOW_SIZE, route_mujoco_warnings
from crptpro.envs.rendering import first_frame_watchdog, render_context
from crptpro.envs.worlds import ActionRange, CheckedWorld, FrameReader, passed_on
from crptpro.errors import CRPTproError, RenderingError, WorldError
from crptpro.values import Quality


class AgentSteps(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A Gymnasium environment in agent steps: actions repeated and scaled, rewards summed, one frame rendered.

    Gymnasium's wrappers need OpenCV (``ResizeObservation``) or render every env step (``AddRenderObservation``), and
    none repeats actions. The settings are those of :func:`crptpro.envs.make_env`; ``world`` is the name in messages.
    """

    def __init__(self, env: Any, *, world: str, image_size: int, action_repeat: int, physics_state: bool, render: bool):
        super().__init__(env)
        self.episode_seed: int | None = None
        self._world, self._image_size, self._action_repeat = world, image_size, action_repeat
        self._renders, self._has_drawn = render, False
        self._read_frame = FrameReader(world)
        action = env.action_space
        if not isinstance(action, spaces.Box):
            raise CRPTproError(
                f"{world} has {type(action).__name__} actions. Only continuous actions (a Box) are supported; wrap it, "
                "and register it with register_domain."
            )
        self._to_actuators = ActionRange(action.low, action.high, action.dtype, world)
        if self._to_actuators.unbounded:
            raise CRPTproError(
                f"{world} has actions without bounds ({action}), which cannot be mapped from [-1, 1]; wrap it with "
                "gymnasium.wrappers.RescaleAction or ClipAction, and register it with register_domain."
            )
        self.action_space = spaces.Box(-1.0, 1.0, (int(np.prod(action.shape)),), np.float32)
        self._data: Any = getattr(env.unwrapped, "data", None)
        self._state_names = [name for name in ("qpos", "qvel") if physics_state and hasattr(self._data, name)]
        observed: dict[str, spaces.Space[Any]] = {"pixels": spaces.Box(0, 255, (3, image_size, image_size), np.uint8)}
        for name in self._state_names:
            observed[name] = spaces.Box(-np.inf, np.inf, getattr(self._data, name).shape, np.float64)
        self.observation_space = spaces.Dict(observed)

    def reset(self, **_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode, with ``episode_seed`` if one was set."""
        self.env.reset(seed=self.episode_seed)
        self.episode_seed = None
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Repeat an action in [-1, 1]; the reward is the sum."""
        command = self._to_actuators(action)
        total = 0.0
        for _ in range(self._action_repeat):
            try:
                _, reward, terminated, truncated, _ = self.env.step(command)
            except ValueError as reason:
                if "expected 5" not in str(reason):
                    raise
                raise WorldError(
                    f"step() of the environment {self._world!r} does not return Gymnasium's five values (observation, "
                    f"reward, terminated, truncated, info): {reason}. The old API ends with `done, info`."
                ) from reason
            total += float(reward)
            if terminated or truncated:
                break
        # A time limit that coincides with a real end is a real end.
        return self._observe(), total, bool(terminated), bool(truncated and not terminated), {}

    def _observe(self) -> dict[str, Any]:
        state = {name: torch.tensor(getattr(self._data, name)) for name in self._state_names}
        return {"pixels": self._draw(), **state}

    def _draw(self) -> Tensor:
        if not self._renders:
            return torch.zeros(3, self._image_size, self._image_size, dtype=torch.uint8)
        viewer = getattr(getattr(self.env.unwrapped, "mujoco_renderer", None), "viewer", None)
        with (
            passed_on(self._world, "render"),
            nullcontext() if self._has_drawn else first_frame_watchdog(),
            render_context(getattr(viewer, "make_context_current", None)),
        ):
            try:
                image = self.env.render()
            except (ImportError, gymnasium.error.Error) as reason:
                raise RenderingError(f"{self._world} does not render: {reason}") from reason
        self._has_drawn = True
        return resize(self._read_frame(image), self._image_size)


class GymnasiumPixelEnv(CheckedWorld, GymWrapper):
    """TorchRL's ``GymWrapper``; ``set_seed`` takes effect at the next reset, because Gymnasium seeds only there."""

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._env.episode_seed = seed


def make_gymnasium(
    task: str, *, camera: int | str | None, quality: Quality, image_size: int, **settings: Any
) -> GymnasiumPixelEnv:
    """Build ``gymnasium:<id>``; the settings are those of :func:`crptpro.envs.make_env`.

    Gymnasium's MuJoCo environments render at twice ``image_size``, others at their own size; images are resized.
    """
    env_id = task[len(GYMNASIUM_PREFIX) :]
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
            hint = " It takes no camera; leave camera unset." if camera is not None else ""
            raise CRPTproError(f"{task} cannot be made with rgb_array rendering: {reason}.{hint}") from reason
        except (ImportError, gymnasium.error.Error) as reason:
            raise CRPTproError(f"{task} cannot be made: {reason}") from reason
    model: Any = getattr(env.unwrapped, "model", None)
    if isinstance(camera, int) and not -1 <= camera < getattr(model, "ncam", camera + 1):
        env.close()  # rendering would end the process
        raise CRPTproError(f"{task} has no camera {camera}; its model has {model.ncam}, numbered from 0.")
    _fix_free_camera(env)
    if quality == "fast" and hasattr(model, "vis"):
        model.vis.quality.shadowsize = min(FAST_SHADOW_SIZE["suite"], model.vis.quality.shadowsize)
    return GymnasiumPixelEnv(env=AgentSteps(env, world=task, image_size=image_size, **settings))


def resize(frame: Tensor, size: int) -> Tensor:
    """Resize a uint8 frame ``[3, H, W]`` to ``[3, size, size]``, bilinear and antialiased, without cropping."""
    if frame.shape[1:] == (size, size):
        return frame
    small = F.interpolate(frame[None].float(), (size, size), mode="bilinear", antialias=True, align_corners=False)
    return small[0].round_().clamp_(0, 255).to(torch.uint8)


def _fix_free_camera(env: Any) -> None:
    """Point the free camera at the model's default pose; the first rendered state differs after a resumption."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    config = getattr(renderer, "default_cam_config", None) or {}
    if renderer is None or "lookat" in config:
        return
    import mujoco

    model = env.unwrapped.model
    pose = mujoco.MjData(model)
    mujoco.mj_forward(model, pose)
    renderer.default_cam_config = {**config, "lookat": np.median(pose.geom_xpos, axis=0)}

"""Any Gymnasium environment that renders RGB, as a simulator with actions in [-1, 1] and square images."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from crptpro.domains import GYMNASIUM_PREFIX
from crptpro.envs.mujoco_log import route_mujoco_warnings
from crptpro.envs.rendering import first_frame_watchdog
from crptpro.envs.simulator import ActionRange, Outcome
from crptpro.errors import CRPTproError, RenderingError


class GymnasiumSimulator:
    """A Gymnasium environment as a :class:`~crptpro.envs.simulator.Simulator`.

    Images are what ``render_mode="rgb_array"`` returns, resized without aliasing (bilinear with the filter
    widened to the scale); Gymnasium's MuJoCo environments render at twice ``image_size``, others at their
    own size. Rewards of the repeated steps are summed; Gymnasium's own truncation and termination are kept.
    The action repeat comes on top of any frame skip of the environment.

    Args:
        env_id: Id in Gymnasium's registry.
        image_size: H = W, pixels.
        action_repeat: Gymnasium steps per agent step.
        camera: Camera index or name of a MuJoCo environment; ``None`` keeps the environment's own.
        shadow_size: Side of the shadow map of a MuJoCo environment, texels; ``None`` keeps the model's.
        description: Goes into the card as it is.

    Raises:
        CRPTproError: for actions that are not a bounded vector, or an environment that does not render RGB.
    """

    def __init__(
        self,
        env_id: str,
        *,
        image_size: int,
        action_repeat: int = 2,
        camera: int | str | None = None,
        shadow_size: int | None = None,
        description: dict[str, Any] | None = None,
    ):
        self._env = _make(env_id, camera, supersampled_size=2 * image_size)
        self._image_size = image_size
        self._action_repeat = action_repeat
        self._description = description or {}
        self._seed: int | None = None
        self._is_first_frame = True
        space = _require_bounded_vector(self._env.action_space, env_id)
        self._to_actuators = ActionRange(space.low, space.high, space.dtype)
        self.action_size = int(np.prod(space.shape))
        self._data: Any = getattr(self._env.unwrapped, "data", None)
        self.state_size = _state_size(self._data)
        _fix_free_camera(self._env)
        model: Any = getattr(self._env.unwrapped, "model", None)
        if shadow_size is not None and hasattr(model, "vis"):
            model.vis.quality.shadowsize = min(shadow_size, model.vis.quality.shadowsize)

    def seed(self, seed: int) -> None:
        """Keep the seed for the next reset, the only moment at which Gymnasium takes one."""
        self._seed = seed

    def reset(self) -> None:
        """Start an episode."""
        self._env.reset(seed=self._seed)
        self._seed = None

    def step(self, action: np.ndarray) -> Outcome:
        """Repeat the action, summing rewards, up to the end of the episode."""
        command = self._to_actuators(action)
        total = 0.0
        for _ in range(self._action_repeat):
            _, reward, terminated, truncated, _ = self._env.step(command)
            total += float(reward)
            if terminated or truncated:
                break
        # A time limit that coincides with a real end is a real end.
        return Outcome(total, bool(terminated), bool(truncated and not terminated))

    def render(self) -> np.ndarray:
        """Return the current image, uint8 ``[H, W, 3]``."""
        if self._is_first_frame:
            image = self._render_first()
            self._is_first_frame = False
        else:
            image = self._env.render()
        return resize(image, self._image_size)

    def _render_first(self) -> np.ndarray:
        import gymnasium

        name = self._env.spec.id
        with first_frame_watchdog():
            try:
                image = self._env.render()
            except (ImportError, gymnasium.error.Error) as reason:
                raise RenderingError(f"{name} does not render: {reason}") from None
        if not (isinstance(image, np.ndarray) and image.ndim == 3 and image.shape[2] == 3):
            raise RenderingError(f"{name} rendered {type(image).__name__} instead of an RGB image.")
        return image

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ``qpos`` and ``qvel``, float64."""
        return self._data.qpos, self._data.qvel

    def card(self) -> dict[str, Any]:
        """Return the description given at construction and the action repeat."""
        return {**self._description, "action_repeat": self._action_repeat}

    def close(self) -> None:
        """Free the environment and its render context."""
        self._env.close()


def resize(image: np.ndarray, size: int) -> np.ndarray:
    """Resize a uint8 image ``[H, W, 3]`` to ``[size, size, 3]``, bilinear and antialiased.

    A non-square image is squeezed, not cropped: everything that is rendered stays visible.
    """
    if image.shape[:2] == (size, size):
        return image
    pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
    small = F.interpolate(pixels, size=(size, size), mode="bilinear", antialias=True, align_corners=False)
    return small[0].round_().clamp_(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()


def _state_size(data: Any) -> tuple[int, int] | None:
    has_state = hasattr(data, "qpos") and hasattr(data, "qvel")
    return (data.qpos.size, data.qvel.size) if has_state else None


def _make(env_id: str, camera: int | str | None, *, supersampled_size: int) -> Any:
    import gymnasium

    name = f"{GYMNASIUM_PREFIX}{env_id}"
    options: dict[str, Any] = {}
    if camera is not None:
        options["camera_name" if isinstance(camera, str) else "camera_id"] = camera
    if str(gymnasium.spec(env_id).entry_point).startswith("gymnasium.envs.mujoco"):
        # Their 480 x 480 by default costs twice the time on software GL and ends as the same few pixels.
        options.update(width=supersampled_size, height=supersampled_size)
        route_mujoco_warnings()
    try:
        return gymnasium.make(env_id, render_mode="rgb_array", disable_env_checker=True, **options)
    except TypeError as reason:
        hint = " It takes no camera; leave camera unset." if camera is not None else ""
        raise CRPTproError(f"{name} cannot be made with rgb_array rendering: {reason}.{hint}") from None
    except (ImportError, gymnasium.error.Error) as reason:
        raise CRPTproError(f"{name} cannot be made: {reason}") from None


def _fix_free_camera(env: Any) -> None:
    """Point Gymnasium's free camera at where the model's default pose lies.

    By itself it looks at the middle of whatever state is drawn first, for good: the same episode would be drawn
    differently as the second one of a process than as the first of a resumed one.
    """
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    config = getattr(renderer, "default_cam_config", None) or {}
    if renderer is None or "lookat" in config:
        return
    import mujoco

    model = env.unwrapped.model
    pose = mujoco.MjData(model)
    mujoco.mj_forward(model, pose)
    renderer.default_cam_config = {**config, "lookat": np.median(pose.geom_xpos, axis=0)}


def _require_bounded_vector(space: Any, env_id: str) -> Any:
    import gymnasium

    name = f"{GYMNASIUM_PREFIX}{env_id}"
    if not isinstance(space, gymnasium.spaces.Box):
        raise CRPTproError(
            f"{name} has {type(space).__name__} actions. Only continuous actions are supported (a "
            "Box); wrap it, and make it known with register_domain."
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise CRPTproError(
            f"{name} has actions without bounds ({space}), which cannot be mapped from [-1, 1]; wrap it with "
            "gymnasium.wrappers.RescaleAction or ClipAction, and make it known with register_domain."
        )
    return space

"""dm_control worlds: scaled actions, action repeat below one persistent camera, time limits told apart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from crptpro.domains import SUITE_TASKS, Domain
from crptpro.envs.background import reverse_background
from crptpro.envs.mujoco_log import route_mujoco_warnings
from crptpro.envs.rendering import first_frame_watchdog
from crptpro.envs.simulator import ActionRange, Outcome
from crptpro.errors import CRPTproError, UnknownNameError

if TYPE_CHECKING:
    import dm_env

#: Side of the shadow map, texels, that ``quality="fast"`` uses instead of the model's own 2048 (suite) or
#: 4096 (manipulation). On software GL the shadow map is half the cost of a frame; fewer than 1 % of pixels
#: change (8 % on the terrain of quadruped_escape, which is all shadows).
FAST_SHADOW_SIZE = {"suite": 512, "manipulation": 1024}

#: MuJoCo's mjMAXVAL: what an action spec of dm_control says of an actuator without control limits.
NO_BOUND = 1e10


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


class SceneCamera:
    """One dm_control ``Camera`` kept alive over steps and resets.

    ``physics.render`` builds and frees a camera and its scene for every image; this one is rebuilt only
    when the model changes, as composer environments do at every reset. The pixels are identical.

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
        model = physics.model
        if model is not self._model:
            self._build(physics, model)
        return self._camera.render()

    def release(self) -> None:
        """Drop the scene; the render context belongs to the physics."""
        self._camera = self._model = None

    def _build(self, physics: Any, model: Any) -> None:
        from dm_control.mujoco.engine import Camera

        self.prepare(physics)  # a composer environment has compiled a new model since
        names = [model.id2name(index, "camera") or str(index) for index in range(model.ncam)]
        if self._camera_id not in (*names, *range(-1, model.ncam)):
            raise CRPTproError(
                f"This model has no camera {self._camera_id!r}. It has {', '.join(names) or 'none'}, or 0 to "
                f"{model.ncam - 1}; -1 is the free camera."
            )
        self._camera = Camera(physics, self._image_size, self._image_size, camera_id=self._camera_id)
        self._model = model


def _bounds(spec: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return what -1 and 1 become; themselves where an actuator has no bounds."""
    low, high = (
        np.broadcast_to(bound, spec.shape).astype(np.float64) for bound in (spec.minimum, spec.maximum)
    )
    is_open = ~(np.abs(low) < NO_BOUND), ~(np.abs(high) < NO_BOUND)
    if (is_open[0] != is_open[1]).any():
        raise CRPTproError(
            f"An actuator is bounded on one side only ({spec}), so [-1, 1] cannot be mapped to it."
        )
    return np.where(is_open[0], -1.0, low), np.where(is_open[1], 1.0, high)


class DmControlSimulator:
    """A dm_control environment as a :class:`~crptpro.envs.simulator.Simulator`.

    Actions are mapped affinely from [-1, 1] to the actuators' ranges (they differ for quadruped and
    manipulation); an actuator without bounds (LQR's) takes the action as it is. Rewards of the repeated env
    steps are summed without discount. A time limit (dm_env: last step with discount 1) is a truncation,
    anything else that ends an episode a termination.

    Args:
        env: ``dm_env.Environment`` with ``physics`` and either ``task.random`` (suite) or ``random_state``
            (composer).
        camera: Draws the images.
        action_repeat: Env steps per agent step, at least 1.
        description: Goes into the card as it is.

    Raises:
        CRPTproError: if an actuator is bounded on one side only.
    """

    def __init__(
        self,
        env: dm_env.Environment,
        camera: SceneCamera,
        *,
        action_repeat: int = 2,
        description: dict[str, Any] | None = None,
    ):
        self._env = env
        spec = env.action_spec()
        self._to_actuators = ActionRange(*_bounds(spec), spec.dtype)
        self._camera = camera
        self._action_repeat = action_repeat
        self._description = description or {}
        self._is_first_frame = True
        self._closed = False
        self.action_size = int(np.prod(spec.shape))
        self.state_size: tuple[int, int] | None = (env.physics.model.nq, env.physics.model.nv)

    def seed(self, seed: int) -> None:
        """Re-seed the generator that the task draws from, without resetting."""
        generator = getattr(self._env, "random_state", None)
        generator = self._env.task.random if generator is None else generator
        generator.seed(seed)

    def reset(self) -> None:
        """Start an episode."""
        self._env.reset()

    def step(self, action: np.ndarray) -> Outcome:
        """Repeat the action, summing rewards, up to the end of the episode."""
        command = self._to_actuators(action)
        reward = 0.0
        for _ in range(self._action_repeat):
            time_step = self._env.step(command)
            reward += time_step.reward or 0.0
            if time_step.last():
                is_time_limit = time_step.discount == 1.0
                return Outcome(reward, not is_time_limit, is_time_limit)
        return Outcome(reward, False, False)

    def render(self) -> np.ndarray:
        """Return the current image, uint8 ``[H, W, 3]``."""
        if self._is_first_frame:
            with first_frame_watchdog():
                image = self._camera.render(self._env.physics)
            self._is_first_frame = False
            return image
        return self._camera.render(self._env.physics)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ``qpos`` and ``qvel``, float64."""
        data = self._env.physics.data
        return data.qpos, data.qvel

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put the world in a state, so that ``render`` draws it; the episode goes on as if it had been in it.

        What a task draws at its reset and keeps in the model (targets, terrain, colours) stays as it is.
        """
        physics = self._env.physics
        physics.data.qpos[:], physics.data.qvel[:] = qpos, qvel
        physics.forward()

    def card(self) -> dict[str, Any]:
        """Return the description given at construction and the action repeat."""
        return {**self._description, "action_repeat": self._action_repeat}

    def close(self) -> None:
        """Free the physics and its render context."""
        if self._closed:
            return
        self._closed = True
        self._camera.release()
        self._env.physics.free()
        self._env.close()

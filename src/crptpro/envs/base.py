"""Checks of every environment: frames that are images, finite numbers, errors that name the environment."""

from __future__ import annotations

import atexit
import logging
import traceback
import weakref
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, GymLikeEnv

from crptpro.errors import CRPTproError, EnvCrashedError, EnvOutputError, NonFiniteError

logger = logging.getLogger(__name__)

#: Action bounds of this magnitude mean "unbounded": MuJoCo's mjMAXVAL (float32's largest is above it).
NO_BOUND = 1e10
#: Agent steps after which an unfinished episode is checked for still frames.
LONG_EPISODE = 25

_open: weakref.WeakSet[EnvBase] = weakref.WeakSet()


class CheckedEnv:
    """Mixin for the class that steps an environment.

    - An exception of the environment's code is raised as :class:`~crptpro.errors.EnvCrashedError`.
    - An action, reward or physical state that is not finite raises :class:`~crptpro.errors.NonFiniteError`.
    - An episode of identical frames is reported by one warning per environment.
    - After ``agent_step_limit`` agent steps an episode is truncated. (``StepCounter`` would add ``step_count``.)
    - The environment is closed at the interpreter's exit: a render context that is freed later prints errors.
    """

    agent_step_limit: int | None = None
    checks_frames = True
    _episode = -1
    _agent_step = 0
    _first_frame: Any = None
    _is_still = False
    _was_closed = False

    def watch(self, name: str, *, agent_step_limit: int | None = None, checks_frames: bool = True) -> None:
        """Set the name in messages, and the checks."""
        self._name, self.agent_step_limit, self.checks_frames = name, agent_step_limit, checks_frames
        _open.add(cast(EnvBase, self))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._require_open()
        if self._agent_step >= LONG_EPISODE:
            self._report_still_frames()
        self._episode, self._agent_step = self._episode + 1, 0
        with passed_on(self._name, "reset"):
            found: TensorDictBase = super()._reset(tensordict, **kwargs)  # type: ignore[misc]
        self._require_finite(found, "returned", "qpos", "qvel")
        self._first_frame = found.get("pixels")
        self._is_still = self.checks_frames
        return found

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._require_open()
        self._agent_step += 1
        self._require_finite(tensordict, "received the", "action")
        with passed_on(self._name, "step"):
            found: TensorDictBase = super()._step(tensordict)  # type: ignore[misc]
        self._require_finite(found, "returned", "reward", "qpos", "qvel")
        if self._agent_step == self.agent_step_limit and not found.get("done").any():
            for flag in ("truncated", "done"):
                found.set(flag, torch.ones_like(found.get(flag)))
        self._is_still = self._is_still and torch.equal(found.get("pixels"), self._first_frame)
        if self._is_still and found.get("done").any():
            self._report_still_frames()
        return found

    def _require_open(self) -> None:
        if self._was_closed:
            raise CRPTproError(
                f"The environment {self._name!r} is closed (a Collector closes its own when it ends); make another."
            )

    def _require_finite(self, td: TensorDictBase, verb: str, *keys: str) -> None:
        for key in keys:
            value = td.get(key, None)
            if value is not None and not value.isfinite().all():
                remedy = "Fix what computes it, or keep the actions where the environment is stable."
                if key == "action":
                    remedy = (
                        "If a policy computed it, training has diverged: lower the learning rate, or use "
                        "precision='fp32'."
                    )
                raise NonFiniteError(
                    f"The environment {self._name!r} {verb} {key} {value.tolist()} in agent step {self._agent_step} of "
                    f"episode {self._episode} (its first is 0). The step is not stored. {remedy}"
                )

    def _report_still_frames(self) -> None:
        if not self._is_still or self._agent_step < 2:
            return
        self.checks_frames = self._is_still = False
        shade = self._first_frame.unique()
        what = f" ({'black' if not shade.any() else 'of one shade'})" if shade.numel() == 1 else ""
        logger.warning(
            "All frames of a whole episode of the environment %r are identical%s, over %d agent steps. Look at what it "
            "renders before you train on it.",
            self._name, what, self._agent_step,
        )  # fmt: skip

    def close(self, *, raise_if_closed: bool = True) -> None:
        _open.discard(cast(EnvBase, self))
        if not self._was_closed:
            self._was_closed = True
            super().close(raise_if_closed=False)  # type: ignore[misc]


@atexit.register
def _close_what_is_open() -> None:
    for env in list(_open):
        with suppress(Exception):
            env.close()


@contextmanager
def passed_on(name: str, call: str) -> Iterator[None]:
    """Raise exceptions of an environment's code in the body as ``EnvCrashedError``, with its name and the call."""
    try:
        yield
    except (CRPTproError, EnvCrashedError):
        raise
    except Exception as reason:
        origin: BaseException = reason
        while origin.__cause__ is not None:  # Gymnasium re-raises exceptions of a constructor
            origin = origin.__cause__
        where = traceback.extract_tb(origin.__traceback__)[-1]
        has_no_gl = "OpenGL platform library has not been loaded" in str(reason)
        remedy = " Call crptpro.envs.select_backend() before it is built." if has_no_gl else ""
        raise EnvCrashedError(
            f"{reason} ({type(reason).__name__} in {call}() of the environment {name!r}, {where.filename}, line "
            f"{where.lineno}){remedy}"
        ) from reason


class SimulatorEnv(CheckedEnv, GymLikeEnv):
    """Mixin for TorchRL's wrappers of simulators: scales the action, and renders one frame per agent step.

    TorchRL's ``from_pixels`` renders every env step of a repeated action. A subclass implements ``_render``, which
    returns an image, and ``_simulation``, whose result may have ``qpos`` and ``qvel``. The settings are those of
    :func:`crptpro.envs.make_env`; ``name`` is the name in messages, ``low`` and ``high`` bound its actions.
    """

    def __init__(
        self,
        env: Any,
        *,
        name: str,
        low: np.ndarray,
        high: np.ndarray,
        dtype: Any,
        image_size: int,
        action_repeat: int,
        render: bool = True,
        physics_state: bool = False,
        **options: Any,
    ):
        self._name, self._image_size, self._renders, self._has_state = name, image_size, render, physics_state
        self._low, self._half = action_range(low, high, dtype, name)
        self._action_dtype = dtype
        super().__init__(env=env, frame_skip=action_repeat, **options)

    def _make_specs(self, env: Any) -> None:
        shape = (3, self._image_size, self._image_size)
        state = {name: Unbounded(value.shape, dtype=value.dtype) for name, value in self._read_state().items()}
        self.observation_spec = Composite(pixels=Bounded(0, 255, shape=shape, dtype=torch.uint8), **state)
        self.action_spec = Bounded(-1.0, 1.0, shape=(self._low.size,), dtype=torch.float32)
        self.reward_spec = Unbounded((1,), dtype=torch.float32)
        flag = Categorical(2, shape=(1,), dtype=torch.bool)
        self.done_spec = Composite({name: flag.clone() for name in ("done", "terminated", "truncated")})

    def read_action(self, action: Tensor) -> np.ndarray:
        centred = action.detach().cpu().double().numpy().reshape(self._low.shape) + 1.0
        return (self._low + self._half * centred).astype(self._action_dtype, copy=False)

    def read_obs(self, observations: Any) -> dict[str, Any]:
        return {"pixels": self._draw(), **self._read_state()}

    def _read_state(self) -> dict[str, Tensor]:
        if not self._has_state:
            return {}
        data = self._simulation()
        found = {name: getattr(data, name) for name in ("qpos", "qvel") if hasattr(data, name)}
        return {name: torch.tensor(value, device="cpu") for name, value in found.items()}

    def _draw(self) -> Tensor:
        if not self._renders:
            return torch.zeros(3, self._image_size, self._image_size, dtype=torch.uint8, device="cpu")
        with passed_on(self._name, "render"):
            image = self._render()
        return resize(read_frame(image, self._name), self._image_size)

    @abstractmethod
    def _render(self) -> Any: ...

    @abstractmethod
    def _simulation(self) -> Any: ...


def resize(frame: Tensor, size: int) -> Tensor:
    """Resize a uint8 frame ``[3, H, W]`` to ``[3, size, size]``, bilinear and antialiased, without cropping."""
    if frame.shape[1:] == (size, size):
        return frame
    small = F.interpolate(frame[None].float(), (size, size), mode="bilinear", antialias=True, align_corners=False)
    return small[0].round_().clamp_(0, 255).to(torch.uint8)


def read_frame(image: Any, name: str) -> Tensor:
    """Copy an RGB image of the environment ``name``, ``[H, W, 3]`` or ``[3, H, W]``, to a frame, uint8 ``[3, H, W]``.

    Anything else raises an ``EnvOutputError``.
    """
    wrong = ""
    if not isinstance(image, (np.ndarray, Tensor)):
        wrong = f"is {type(image).__name__}"
    elif image.ndim != 3 or 3 not in (image.shape[0], image.shape[2]):
        wrong = f"has shape {tuple(image.shape)}"
    elif (dtype := str(image.dtype).removeprefix("torch.")) != "uint8":
        wrong = f"has dtype {dtype}"
    if wrong:
        raise EnvOutputError(
            f"The image that the environment {name!r} renders {wrong}; it must be an RGB array [H, W, 3] of uint8. "
            "Multiply floats from 0 to 1 by 255."
        )
    # The copy is for arrays that are read-only or have negative strides.
    pixels = image if isinstance(image, Tensor) else torch.from_numpy(image.copy())
    if pixels.shape[2] == 3:
        pixels = pixels.permute(2, 0, 1)
    return pixels.clone(memory_format=torch.contiguous_format)


def action_range(low: np.ndarray, high: np.ndarray, dtype: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return lower bounds and half-widths of an environment's actions; actions without bounds get [-1, 1].

    Bounds that [-1, 1] cannot be mapped to raise a ``CRPTproError``.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    is_free = np.minimum(np.abs(low), np.abs(high)) >= NO_BOUND
    low, high = np.where(is_free, -1.0, low), np.where(is_free, 1.0, high)
    has_width = (np.maximum(np.abs(low), np.abs(high)) < NO_BOUND) & (low < high)
    if not (np.issubdtype(dtype, np.floating) and low.size and has_width.all()):
        raise CRPTproError(
            f"[-1, 1] cannot be mapped to the actions of the environment {name!r}: {np.dtype(dtype)} from "
            f"{low.tolist()} to {high.tolist()}. Wrap it in one whose actions are floats, with a lower and an upper "
            "bound each."
        )
    return low, (high - low) / 2.0

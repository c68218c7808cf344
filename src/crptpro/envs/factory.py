"""Build the TorchRL environment of a task, which emits stacks of uint8 frames."""

from __future__ import annotations

import inspect
import logging
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite
from torchrl.envs import CatFrames, Compose, DoubleToFloat, EnvBase, Transform, TransformedEnv
from torchrl.envs.transforms import SelectTransform

from crptpro.domains import GYMNASIUM_PREFIX, LONGEST_EPISODE_AGENT_STEPS, Domain, get_domain
from crptpro.envs.base import CheckedEnv, passed_on, read_frame
from crptpro.envs.rendering import select_backend
from crptpro.errors import CRPTproError
from crptpro.values import MAX_SEED, Colors, Quality, as_int, check_choices

logger = logging.getLogger(__name__)


def make_env(
    task: str | Domain,
    *,
    seed: int,
    image_size: int = 84,
    action_repeat: int | None = None,
    frame_stack: int = 3,
    quality: Quality = "exact",
    colors: Colors = "normal",
    physics_state: bool = False,
    render: bool = True,
) -> EnvBase:
    """Build an unbatched CPU environment that renders once per agent step.

    It is TorchRL's ``DMControlWrapper`` or ``GymWrapper``, or what your ``make`` returns, with ``CatFrames`` and the
    checks of :class:`~crptpro.envs.base.CheckedEnv`. Create, step and close a dm_control environment in one thread.

    Keys: ``pixels`` uint8 ``[3 * frame_stack, H, W]``, oldest to newest (a reset repeats its first frame); ``action``
    float32 ``[A]`` in [-1, 1]; ``("next", "reward")`` float32 ``[1]``, summed over the repeated env steps; ``done``,
    ``terminated``, ``truncated`` (by the time limit, or without one after 1000 agent steps). ``env.set_seed(s)`` seeds
    the next ``reset`` without resetting.

    Args:
        task: a name that :func:`crptpro.domains.get_domain` knows, or a :class:`~crptpro.domains.Domain`.
        seed: of the first episode, from 0 to 2**32 - 1.
        image_size: H = W, pixels.
        action_repeat: env steps per agent step; ``None`` takes the domain's (2; 1 for your own).
        frame_stack: frames per observation.
        quality: ``"fast"`` renders smaller shadow maps, up to twice as fast on software GL, with fewer than 1 % of the
            pixels changed (quadruped_escape: 8 %).
        colors: ``"reversed_background"`` reverses the order of the RGB values of skybox and floor, the paper's unseen
            colours (dm_control only); ``"reversed_image"`` that of whole images.
        physics_state: also emit ``qpos`` and ``qvel``, float64, of a MuJoCo environment.
        render: ``False`` leaves images black, for policies that ignore them: ten times faster, with the same rewards.
            Your own environments ignore it.

    Raises:
        ValueError: a number is invalid or out of range.
        CRPTproError: an unknown task, unusable options or environment, or no GL backend that renders.
    """
    domain = get_domain(task)
    seed = as_int(seed, "seed", minimum=0, maximum=MAX_SEED)
    frame_stack = as_int(frame_stack, "frame_stack", minimum=1)
    settings: dict[str, Any] = {
        "image_size": as_int(image_size, "image_size", minimum=1), "camera": domain.camera, "quality": quality,
        "action_repeat": resolve_action_repeat(domain, action_repeat), "physics_state": physics_state,
    }  # fmt: skip
    check_choices(quality=quality, colors=colors)
    is_dm_control = domain.source in ("suite", "manipulation")
    reverses_background = colors == "reversed_background"
    if reverses_background and not is_dm_control:
        raise CRPTproError(
            f"The background of {domain.name!r} is not known: only dm_control's environments can have it reversed. "
            "colors='reversed_image' reverses the colours of whole images in any environment."
        )
    if needs_gl(domain):
        select_backend()
    base: Any
    if domain.source == "own":
        base = _own(domain, seed=seed, **settings)
    elif is_dm_control:
        from crptpro.envs.dm_control import make_dm_control  # late: dm_control keeps the GL backend of its import

        base = make_dm_control(domain, render=render, reverses_background=reverses_background, **settings)
    else:
        from crptpro.envs.gymnasium import make_gymnasium

        base = make_gymnasium(domain.task, render=render, **settings)
    limit = episode_length(domain, action_repeat=action_repeat) or LONGEST_EPISODE_AGENT_STEPS
    base.watch(domain.task, agent_step_limit=limit, checks_frames=render or domain.source == "own")
    transforms: list[Transform] = []
    if colors == "reversed_image":
        from crptpro.transforms.color_swap import ColorSwap  # late: its package imports the networks

        transforms.append(ColorSwap(in_keys=["pixels"]))
    if frame_stack > 1:
        transforms.append(CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))
    env: EnvBase = TransformedEnv(base, Compose(*transforms)) if transforms else base
    env.set_seed(seed)
    return env


def resolve_action_repeat(task: str | Domain, action_repeat: int | None = None) -> int:
    """Return the env steps of one agent step: ``action_repeat``, or the domain's if ``None``."""
    if action_repeat is None:
        return get_domain(task).action_repeat
    return as_int(action_repeat, "action_repeat", minimum=1)


def episode_length(task: str | Domain, *, action_repeat: int | None = None) -> int | None:
    """Return the agent steps of a full episode (500; manipulation 125), ``None`` if unknown or unlimited."""
    domain = get_domain(task)
    repeat = resolve_action_repeat(domain, action_repeat)
    return None if domain.episode_env_steps is None else -(-domain.episode_env_steps // repeat)


def needs_gl(task: str | Domain) -> bool:
    """Return whether MuJoCo renders the frames (dm_control and some of Gymnasium), which needs a GL backend."""
    domain = get_domain(task)
    if domain.source != "gymnasium":
        return domain.source != "own"
    import gymnasium

    made_by = str(gymnasium.spec(domain.task.removeprefix(GYMNASIUM_PREFIX)).entry_point).lower()
    return any(name in made_by for name in ("mujoco", "dm_control", "gymnasium_robotics"))


class OwnEnv(CheckedEnv, TransformedEnv):
    """A user's TorchRL environment inside the transforms that adapt it."""


class FrameTransform(Transform):
    """Converts ``pixels`` with :func:`~crptpro.envs.base.read_frame`, and adds ``truncated`` if it is missing.

    TorchRL's ``PermuteTransform`` returns a view of the environment's buffer, ``ToTensorImage`` divides uint8 by 255.
    """

    def __init__(self, name: str, image_size: int):
        super().__init__(in_keys=["pixels"], out_keys=["pixels"])
        self._name = name
        self._shape = (3, image_size, image_size)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec["pixels"] = Bounded(0, 255, shape=self._shape, dtype=torch.uint8)
        return observation_spec

    def transform_done_spec(self, done_spec: Composite) -> Composite:
        done_spec = done_spec.clone()
        if "truncated" not in done_spec.keys():  # noqa: SIM118
            done_spec["truncated"] = done_spec["done"].clone()
        return done_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set("pixels", read_frame(next_tensordict.get("pixels"), self._name))
        if next_tensordict.get("truncated", None) is None:
            next_tensordict.set("truncated", torch.zeros_like(next_tensordict.get("done")))
        return next_tensordict


def _own(domain: Domain, **settings: Any) -> EnvBase:
    make = domain.make
    if make is None:
        raise CRPTproError(f"Domain {domain.name!r} has no make, the function that builds its environment.")
    named = _named_by(make, settings)
    if settings["quality"] != "exact" and "quality" not in named:
        logger.warning("The make of domain %r takes no quality: %r changes nothing.", domain.name, settings["quality"])
    if settings["action_repeat"] != domain.action_repeat and "action_repeat" not in named:
        raise CRPTproError(
            f"The make of domain {domain.name!r} takes no action_repeat: an agent step is {domain.action_repeat} env "
            f"step(s), not {settings['action_repeat']}. Use action_repeat={domain.action_repeat}."
        )
    with passed_on(domain.task, "make"):
        env = make(**named)
    if broken := _broken_contract(env, settings["image_size"]):
        raise CRPTproError(f"The environment of domain {domain.name!r} {broken} (see crptpro.domains.Domain).")
    base = env
    while isinstance(base, TransformedEnv):
        base = base.base_env
    # What the next step reads stays: states, and entries of transforms such as StepCounter.
    wanted = {"pixels", *(("qpos", "qvel") if settings["physics_state"] else ()), *env.full_state_spec.keys(True, True)}
    dropped = set(base.observation_spec.keys(True, True)) - wanted
    kept = [key for key in env.observation_spec.keys(True, True) if key not in dropped]
    transforms: list[Transform] = [SelectTransform(*kept), FrameTransform(domain.task, settings["image_size"])]
    rewards = ["reward"] if env.reward_spec.dtype == torch.float64 else []
    actions = ["action"] if env.action_spec.dtype == torch.float64 else []
    if rewards or actions:
        transforms.append(DoubleToFloat(in_keys=rewards, in_keys_inv=actions))
    return OwnEnv(env, Compose(*transforms), auto_unwrap=False)


def _named_by(make: Any, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that ``make`` names and that no ``partial`` has bound."""
    bound = set(getattr(make, "keywords", ()))
    function = getattr(make, "func", make)
    # TorchRL's metaclass hides the signature of an environment's constructor.
    parameters = inspect.signature(function.__init__ if inspect.isclass(function) else make).parameters
    takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    wanted = {name for name in settings if takes_all or name in parameters} - bound
    return {name: value for name, value in settings.items() if name in wanted}


def _broken_contract(env: Any, image_size: int) -> str:
    """Return how a user's environment breaks the contract of ``Domain.make``; empty if it does not."""
    if not isinstance(env, EnvBase):
        return f"is a {type(env).__name__}; make must return a TorchRL EnvBase"
    if env.device is not None and env.device.type != "cpu":
        return f"is on {env.device}; it must be on the CPU, where frames are stored"
    if env.batch_size != torch.Size([]):
        return f"has batch size {tuple(env.batch_size)}; it must be unbatched"
    shown = env.observation_spec
    if "pixels" not in set(shown.keys()):
        return f"emits {sorted(map(str, shown.keys()))}, but no 'pixels'"
    shape = tuple(shown["pixels"].shape)
    allowed = ((3, image_size, image_size), (image_size, image_size, 3))
    if shape not in allowed:
        return f"emits pixels of shape {shape}; expected one RGB image, {allowed[0]} or {allowed[1]}"
    action = env.action_spec
    low: Any = getattr(action.space, "low", None)
    high: Any = getattr(action.space, "high", None)
    if not action.dtype.is_floating_point or low is None or len(action.shape) != 1 or 0 in action.shape:
        return f"has the action {action}; it must be a bounded float vector"
    if not ((low == -1).all() and (high == 1).all()):
        return "has action bounds other than [-1, 1]; let make scale the actions"
    if tuple(env.reward_spec.shape) != (1,):
        return f"has rewards of shape {tuple(env.reward_spec.shape)}; expected (1,)"
    return ""

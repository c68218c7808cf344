"""A user's own TorchRL environment, checked and brought to the form that every other environment here has."""

from __future__ import annotations

import functools
import inspect
import logging
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import DoubleToFloat, EnvBase, PermuteTransform, Transform, TransformedEnv
from torchrl.envs.transforms import SelectTransform

from crptpro.domains import Domain
from crptpro.errors import CRPTproError

logger = logging.getLogger(__name__)

_OFFERED = ("seed", "image_size", "action_repeat", "camera", "quality", "physics_state")


class NeverTruncated(Transform):
    """Adds ``truncated``, always False, to an environment whose episodes end by termination alone."""

    def transform_done_spec(self, done_spec: Composite) -> Composite:
        """Add ``truncated``, a copy of ``done``."""
        done_spec = done_spec.clone()
        done_spec["truncated"] = done_spec["done"].clone()
        return done_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("truncated", torch.zeros_like(tensordict_reset.get("done")))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("truncated", torch.zeros_like(next_tensordict.get("done")))


def make_own_env(domain: Domain, **settings: Any) -> EnvBase:
    """Call ``domain.make`` with the settings that it names, check what it returns, and make pixels CHW.

    Keys other than ``pixels`` (and ``qpos``, ``qvel`` if asked for) are dropped; ``truncated`` is added, False, if
    it is missing.

    Raises:
        CRPTproError: naming the part of the contract (see :class:`~crptpro.domains.Domain`) that is not kept.
    """
    make = domain.make
    if make is None:
        raise CRPTproError(f"Domain {domain.name!r} has no make, the function that builds its environment.")
    accepted = _accepted(make, settings)
    if settings.get("quality", "exact") != "exact" and "quality" not in accepted:
        logger.warning(
            "The make of domain %r takes no quality: it draws as ever, not with quality=%r.",
            domain.name, settings["quality"],
        )  # fmt: skip
    env = make(**accepted)
    layout = _check(domain, env, image_size=settings["image_size"])
    state = ("qpos", "qvel") if settings["physics_state"] else ()
    kept = [key for key in ("pixels", *state) if key in env.observation_spec.keys(True, True)]
    transforms: list[Transform] = []
    if set(kept) != set(env.observation_spec.keys(True, True)):
        transforms.append(SelectTransform(*kept))
    if layout == "HWC":
        transforms.append(PermuteTransform((-1, -3, -2), in_keys=["pixels"]))
    if "truncated" not in set(env.full_done_spec.keys()):
        transforms.append(NeverTruncated())
    if torch.float64 in (env.reward_spec.dtype, env.action_spec.dtype):
        is_double = env.action_spec.dtype == torch.float64
        actions = {"in_keys_inv": ["action"]} if is_double else {"in_keys_inv": []}
        rewards = ["reward"] if env.reward_spec.dtype == torch.float64 else []
        transforms.append(DoubleToFloat(in_keys=rewards, **actions))
    for transform in transforms:
        env = with_transform(env, transform)
    return env


def with_transform(env: EnvBase, transform: Transform) -> EnvBase:
    """Return ``env`` with one more transform, nesting nothing (TorchRL warns about nested environments)."""
    return (
        env.append_transform(transform) if isinstance(env, TransformedEnv) else TransformedEnv(env, transform)
    )


def repeats_actions(domain: Domain) -> bool:
    """Whether the domain's ``make`` takes ``action_repeat``; otherwise its agent steps are of one length."""
    return domain.make is None or "action_repeat" in _accepted(domain.make, dict.fromkeys(_OFFERED))


def fixed_action_repeat(domain: Domain) -> int:
    """Return the env steps of an agent step where ``make`` does not ask: what a ``partial`` of it binds, or 1."""
    return int(_bound(domain.make).get("action_repeat", 1))


def _bound(make: Any) -> dict[str, Any]:
    return make.keywords if isinstance(make, functools.partial) else {}


def _accepted(make: Any, settings: dict[str, Any]) -> dict[str, Any]:
    """Settings that ``make`` names; what a ``partial`` has bound is decided and not asked for again."""
    parameters = inspect.signature(make).parameters
    takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    return {
        name: settings[name]
        for name in _OFFERED
        if (takes_all or name in parameters) and name not in _bound(make)
    }


def _check(domain: Domain, env: Any, *, image_size: int) -> str:
    """Return ``"CHW"`` or ``"HWC"``; raise for what the rest of the library cannot use."""

    def refuse(what: str) -> CRPTproError:
        return CRPTproError(f"The environment of domain {domain.name!r} {what} (see crptpro.domains.Domain).")

    if not isinstance(env, EnvBase):
        raise refuse(f"is a {type(env).__name__}; make must return a TorchRL EnvBase")
    if env.device is not None and env.device.type != "cpu":
        raise refuse(f"lives on {env.device}; it must be on the CPU, where frames are stored")
    if env.batch_size != torch.Size([]):
        raise refuse(f"has batch size {tuple(env.batch_size)}; it must be unbatched")
    if "pixels" not in set(env.observation_spec.keys()):
        raise refuse(f"emits {sorted(map(str, env.observation_spec.keys()))}, but no 'pixels'")
    spec = env.observation_spec["pixels"]
    if spec.dtype != torch.uint8:
        raise refuse(f"emits pixels of {spec.dtype}; they must be torch.uint8")
    layouts = {(3, image_size, image_size): "CHW", (image_size, image_size, 3): "HWC"}
    layout = layouts.get(tuple(spec.shape))
    if layout is None:
        expected = " or ".join(map(str, layouts))
        raise refuse(f"emits pixels of shape {tuple(spec.shape)}; expected one RGB image, {expected}")
    action = env.action_spec
    low: Any = getattr(action.space, "low", None)
    high: Any = getattr(action.space, "high", None)
    if not action.dtype.is_floating_point or low is None or len(action.shape) != 1:
        raise refuse(f"has the action {action}; it must be a bounded float vector")
    if not ((low == -1).all() and (high == 1).all()):
        raise refuse("has action bounds other than [-1, 1]; let make scale the actions")
    if tuple(env.reward_spec.shape) != (1,):
        raise refuse(f"has rewards of shape {tuple(env.reward_spec.shape)}; expected (1,)")
    return layout

"""A simulator's positions and velocities as named numbers that a linear probe can predict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from crptpro.domains import GYMNASIUM_PREFIX, Domain, get_domain
from crptpro.errors import UnknownNameError

_SIZES = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1), "turning": (1, 1)}
"""Length in ``qpos`` and in ``qvel`` of each kind of joint, the first four in the order of ``mjtJoint``."""


class Joint(NamedTuple):
    """One joint of a MuJoCo model; a ``"hinge"`` has limits, ``"turning"`` is a hinge without any."""

    name: str
    kind: str


def joints_of(domain: str | Domain) -> tuple[Joint, ...] | None:
    """Return the joints behind a domain's ``qpos`` and ``qvel``, in order.

    ``None`` if they are unknown: a custom environment, or one without a MuJoCo model. Raises a ``RenderingError`` if
    dm_control cannot be loaded because no backend renders.
    """
    try:
        domain = get_domain(domain)
    except UnknownNameError:  # a custom domain that is not registered in this process
        return None
    env: Any
    if domain.source in ("suite", "manipulation"):
        from crptpro.envs.dm_control import load_dm_env
        from crptpro.envs.rendering import select_backend

        select_backend()  # importing dm_control fixes the backend
        env = load_dm_env(domain)
        model = env.physics.model.ptr
    elif domain.source == "gymnasium":
        import gymnasium

        env = gymnasium.make(domain.task[len(GYMNASIUM_PREFIX) :], disable_env_checker=True)
        model = getattr(env.unwrapped, "model", None)
    else:
        return None
    joints = []
    for index in range(model.njnt if model is not None else 0):
        kind = list(_SIZES)[model.jnt_type[index]]
        if kind == "hinge" and not model.jnt_limited[index]:
            kind = "turning"
        joints.append(Joint(model.joint(index).name or f"joint{index}", kind))
    env.close()
    return None if model is None else tuple(joints)


def position_coordinates(qpos: Tensor, joints: Sequence[Joint] | None) -> tuple[list[str], Tensor]:
    """Return names, and positions as float64 ``[N, len(names)]`` that change continuously with the image.

    Slides and limited hinges are kept. A hinge without limits becomes its sine and cosine. The orientation of a ball or
    free joint becomes the first two columns of its rotation matrix, which determine it. If the joints do not
    match, ``qpos`` (``[N, nq]``: metres, radians, quaternions w, x, y, z) is returned unchanged.
    """
    qpos = qpos.double()
    sizes = [_SIZES[joint.kind][0] for joint in joints or ()]
    if joints is None or sum(sizes) != qpos.shape[1]:
        return [f"qpos[{index}]" for index in range(qpos.shape[1])], qpos
    names: list[str] = []
    columns: list[Tensor] = []
    for joint, values in zip(joints, qpos.split(sizes, dim=1)):
        if joint.kind in ("slide", "hinge"):
            names.append(joint.name)
        elif joint.kind == "turning":
            names += [f"sin {joint.name}", f"cos {joint.name}"]
            values = torch.cat([values.sin(), values.cos()], 1)
        else:
            if joint.kind == "free":
                names += [f"{joint.name}.{axis}" for axis in "xyz"]
            names += [f"{joint.name}.r{row}{column}" for column in (1, 2) for row in (1, 2, 3)]
            values = torch.cat([values[:, :-4], _two_columns(values[:, -4:])], 1)
        columns.append(values)
    return names, torch.cat(columns, 1)


def velocity_coordinates(qvel: Tensor, joints: Sequence[Joint] | None) -> tuple[list[str], Tensor]:
    """Return names, and velocities ``[N, nv]`` (m/s and rad/s) as float64."""
    if joints is None or sum(_SIZES[joint.kind][1] for joint in joints) != qvel.shape[1]:
        return [f"qvel[{index}]" for index in range(qvel.shape[1])], qvel.double()
    turns = {"free": ("vx", "vy", "vz", "wx", "wy", "wz"), "ball": ("wx", "wy", "wz")}
    parts = [(joint.name, turns.get(joint.kind, ("",))) for joint in joints]
    return [f"{name}.{axis}" if axis else name for name, axes in parts for axis in axes], qvel.double()


def _two_columns(quaternions: Tensor) -> Tensor:
    """Return the first two columns, ``[N, 6]``, of the rotation matrices of quaternions ``[N, 4]``."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    second = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
    return torch.stack([*first, *second], 1)

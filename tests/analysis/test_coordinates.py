from __future__ import annotations

import math

import pytest
import torch

from crptpro.analysis.coordinates import Joint, joints_of, position_coordinates, velocity_coordinates
from crptpro.domains import Domain, get_domain

JOINTS = (Joint("root", "free"), Joint("knee", "hinge"), Joint("wheel", "turning"), Joint("rail", "slide"))


def quaternion(angle: float, axis: tuple[float, float, float]) -> list[float]:
    return [math.cos(angle / 2), *(math.sin(angle / 2) * part for part in axis)]


def positions(*, turn: float = 0.3, wheel: float = 0.5, sign: float = 1.0) -> dict[str, float]:
    qpos = [1.0, 2.0, 3.0, *(sign * part for part in quaternion(turn, (0, 0, 1))), 0.7, wheel, -4.0]
    names, values = position_coordinates(torch.tensor([qpos]), JOINTS)
    assert values.dtype == torch.float64
    return dict(zip(names, values[0].tolist()))


def test_each_joint_has_its_coordinates() -> None:
    found = positions()
    assert list(found) == [
        "root.x", "root.y", "root.z", "root.r11", "root.r21", "root.r31", "root.r12", "root.r22", "root.r32",
        "knee", "sin wheel", "cos wheel", "rail",
    ]  # fmt: skip
    expected = [1, 2, 3, math.cos(0.3), math.sin(0.3), 0, -math.sin(0.3), math.cos(0.3), 0, 0.7,
                math.sin(0.5), math.cos(0.5), -4]  # fmt: skip
    assert list(found.values()) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("same", [{"wheel": 0.5 + 2 * math.pi}, {"turn": 0.3 + 2 * math.pi}, {"sign": -1.0}])
def test_what_looks_the_same_has_the_same_coordinates(same: dict[str, float]) -> None:
    assert list(positions(**same).values()) == pytest.approx(list(positions().values()), abs=1e-5)


def test_velocities_stay_as_they_are() -> None:
    qvel = torch.arange(9.0)[None]
    names, values = velocity_coordinates(qvel, JOINTS)
    assert names == [
        *(f"root.{part}" for part in ("vx", "vy", "vz", "wx", "wy", "wz")),
        "knee",
        "wheel",
        "rail",
    ]
    assert values.equal(qvel.double())


@pytest.mark.parametrize("joints", [None, JOINTS])
def test_without_fitting_joints_numbers_are_numbered(joints: tuple[Joint, ...] | None) -> None:
    assert position_coordinates(torch.zeros(1, 2), joints)[0] == ["qpos[0]", "qpos[1]"]
    assert velocity_coordinates(torch.zeros(1, 2), joints)[0] == ["qvel[0]", "qvel[1]"]


def test_joints_are_those_of_the_model_and_unknown_without_one() -> None:
    for unknown in (Domain("own", "own"), "nobody_knows_this", "gymnasium:Pendulum-v1"):
        assert joints_of(unknown) is None
    assert joints_of("gymnasium:InvertedPendulum-v5") == (("slider", "slide"), ("hinge", "hinge"))


@pytest.mark.gl
@pytest.mark.parametrize(("task", "kinds"), [
    ("cheetah", {"rootx": "slide", "rooty": "turning", "bthigh": "hinge"}),
    ("quadruped", {"root": "free"}),
    ("pendulum", {"hinge": "turning"}),
])  # fmt: skip
def test_joints_of_real_domains(task: str, kinds: dict[str, str]) -> None:
    found = joints_of(get_domain(task))
    assert found is not None
    assert kinds.items() <= dict(found).items()

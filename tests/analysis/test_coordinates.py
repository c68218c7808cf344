from __future__ import annotations

import math

import pytest
import torch

from crptpro.analysis.coordinates import Joint, joints_of, position_coordinates, velocity_coordinates
from crptpro.domains import Domain, get_domain

JOINTS = (Joint("root", "free"), Joint("knee", "hinge"), Joint("wheel", "turning"), Joint("rail", "slide"))


def positions(*, turn: float = 0.3, wheel: float = 0.5, sign: float = 1.0) -> dict[str, float]:
    quaternion = [sign * math.cos(turn / 2), 0.0, 0.0, sign * math.sin(turn / 2)]
    names, values = position_coordinates(torch.tensor([[1.0, 2.0, 3.0, *quaternion, 0.7, wheel, -4.0]]), JOINTS)
    assert values.dtype == torch.float64
    return dict(zip(names, values[0].tolist()))


def test_each_joint_has_its_coordinates() -> None:
    cos, sin = math.cos(0.3), math.sin(0.3)
    expected = {
        "root.x": 1, "root.y": 2, "root.z": 3, "root.r11": cos, "root.r21": sin, "root.r31": 0, "root.r12": -sin,
        "root.r22": cos, "root.r32": 0, "knee": 0.7, "sin wheel": math.sin(0.5), "cos wheel": math.cos(0.5), "rail": -4,
    }  # fmt: skip
    assert list(positions()) == list(expected)
    assert positions() == pytest.approx(expected, abs=1e-6)
    names, values = velocity_coordinates(torch.arange(9.0)[None], JOINTS)
    turns = [f"root.{part}" for part in ("vx", "vy", "vz", "wx", "wy", "wz")]
    assert names == [*turns, "knee", "wheel", "rail"]
    assert values.equal(torch.arange(9.0)[None].double())


@pytest.mark.parametrize("same", [{"wheel": 0.5 + 2 * math.pi}, {"turn": 0.3 + 2 * math.pi}, {"sign": -1.0}])
def test_equal_poses_have_equal_coordinates(same: dict[str, float]) -> None:
    assert positions(**same) == pytest.approx(positions(), abs=1e-5)


@pytest.mark.parametrize("joints", [None, JOINTS])
def test_without_fitting_joints_coordinates_are_numbered(joints: tuple[Joint, ...] | None) -> None:
    assert position_coordinates(torch.zeros(1, 2), joints)[0] == ["qpos[0]", "qpos[1]"]
    assert velocity_coordinates(torch.zeros(1, 2), joints)[0] == ["qvel[0]", "qvel[1]"]


def test_joints_are_those_of_the_model_and_unknown_without_one() -> None:
    for unknown in (Domain("own", "own"), "nobody_knows_this", "gymnasium:Pendulum-v1"):
        assert joints_of(unknown) is None
    assert joints_of("gymnasium:InvertedPendulum-v5") == (("slider", "slide"), ("hinge", "hinge"))


@pytest.mark.gl
def test_joints_of_real_domains() -> None:
    found = {name: dict(joints_of(get_domain(name)) or ()) for name in ("cheetah", "quadruped", "pendulum")}
    assert {"rootx": "slide", "rooty": "turning", "bthigh": "hinge"}.items() <= found["cheetah"].items()
    assert found["quadruped"]["root"] == "free"
    assert found["pendulum"] == {"hinge": "turning"}

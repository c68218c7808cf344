"""Worlds that a plugin brings along: every process that builds one knows what the plugin has registered."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
from command import Call

from crptpro import doctor, plugins
from crptpro.data import FrameDataset

WORLD = "PluginsWorld-v0"
PLUGIN = f'''
import gymnasium
import numpy as np


class World(gymnasium.Env):
    """A shade of grey that the action sets."""

    metadata = {{"render_modes": ["rgb_array"]}}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,))
    render_mode, shade = "rgb_array", 0.5

    def __init__(self, render_mode="rgb_array"):
        pass

    def reset(self, seed=None, options=None):
        return np.zeros(1, np.float32), {{}}

    def step(self, action):
        self.shade = float(action[0] + 1) / 2
        return np.zeros(1, np.float32), self.shade, False, False, {{}}

    def render(self):
        picture = np.full((16, 16, 3), int(255 * self.shade), np.uint8)
        picture[:8] = 0
        return picture


gymnasium.register("{WORLD}", World, max_episode_steps=20)
'''


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file that registers a world of Gymnasium's; it is forgotten afterwards."""
    monkeypatch.setattr(plugins, "_loaded", [])
    monkeypatch.setattr(sys, "path", sys.path[:])
    path = tmp_path / "plugin_of_a_world.py"
    path.write_text(PLUGIN)
    yield path
    sys.modules.pop(path.stem, None)
    gymnasium.registry.pop(WORLD, None)


def test_a_plugins_world_is_collected_and_learned_with_evaluating_processes(
    call: Call, tmp_path: Path, plugin: Path
) -> None:
    task = f"gymnasium:{WORLD}"
    collect = ("collect", task, "--transitions", 15, "--workers", 1, "--out", tmp_path / "data")
    status, _, err = call("--plugin", plugin, *collect)
    assert status == 0, err
    (path,) = (tmp_path / "data").iterdir()
    assert len(FrameDataset.open(path)) == 15

    learn = (
        "downstream",
        task,
        "--pretrained",
        "random-encoder",
        "--out",
        tmp_path / "run",
        "--env-steps",
        24,
    )
    few = (
        "--random-agent-steps", 4, "--batch-size", 4, "--replay-capacity", 20, "--eval-episodes", 1,
        "--eval-interval-env-steps", 24, "--hidden-dim", 8, "--queue-size", 16, "--eval-workers", 1,
    )  # fmt: skip
    status, _, err = call("--plugin", plugin, *learn, *few)
    assert status == 0, err
    assert "MUJOCO" not in err


def test_the_doctor_looks_at_a_plugins_world(
    call: Call, plugin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugins.load_plugin(str(plugin))
    (entry,) = doctor.render_domains((f"gymnasium:{WORLD}",), "egl", 100.0)
    assert entry["error"] == ""
    assert entry["agent_step_ms"] > 0

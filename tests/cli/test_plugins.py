"""What a plugin registers, methods and environments, has names in every command and every process."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from command import SIZE, SMALL, TASK, Call, refused, rows

from crptpro import doctor, plugins
from crptpro.data import FrameDataset
from crptpro.modules import PixelEncoder
from crptpro.objectives import get_method, method_names
from crptpro.pretrained import load_pretrained
from crptpro.training import pretrain

pytestmark = pytest.mark.usefixtures("plugins_are_forgotten")
METHODS = Path(__file__).with_name("own_method.py")
ENVIRONMENT = Path(__file__).parents[1] / "experiments" / "slow_env.py"


def test_a_plugin_registers_a_method(call: Call, dataset: Path, tmp_path: Path) -> None:
    assert "slowness" not in method_names()
    out = tmp_path / "out"
    own = ("pretrain", dataset, "--out", out, "--method", "slowness", "--log-interval", 1, "--plugin", METHODS)
    assert call(*own)[0] == 0
    assert {"slowness", "slowness-active"} <= set(method_names())  # what lists methods lists it
    loaded = load_pretrained(out / "encoder")
    assert (loaded.method, loaded.card["training"]["updates"]) == ("slowness", 2)
    assert float(rows(out / "pretrain.csv")[-1]["loss_slow"]) > 0

    again = (out / "encoder", dataset, "--out", tmp_path / "fine", "--updates", 1, "--batch-size", 4)
    assert call("finetune", *again, "--plugin", METHODS)[0] == 0
    assert load_pretrained(tmp_path / "fine" / "encoder").label == "slowness-finetune"

    # In Python it is one line.
    loss = get_method("slowness").build(PixelEncoder(image_size=SIZE))
    assert pretrain(loss, dataset, progress=False).updates == 2


def test_a_users_method_explores_with_its_own_reward(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "out"
    own = ("--plugin", METHODS, "pretrain", TASK, "--out", out, "--method", "slowness-active")
    few = ("--log-interval", 1, "--hidden-dim", 8, "--replay-capacity", 40)
    status, _, err = call(*own, *few)
    assert status == 0, err
    loaded = load_pretrained(out / "encoder")
    assert (loaded.method, loaded.card["loss"]["config"]["margin"]) == ("slowness-active", 0.5)
    explored = rows(out / "explore.csv")
    told = [row["intrinsic_reward/toy-fixed"] for row in explored]
    rewards = [float(reward) for reward in told if reward]
    assert len(rewards) >= len(explored) - 1  # the first row may come before the agent's first update
    assert min(rewards) > 0

    down = ("downstream", TASK, "--pretrained", out / "encoder", "--out", tmp_path / "down", *SMALL)
    assert call(*down)[0] == 0
    assert {row["method"] for row in rows(tmp_path / "down" / "eval.csv")} == {"slowness-active"}

    before = (out / "pretrain.csv").read_bytes()
    status, _, err = call(*own, *few)
    assert status == 0
    assert (out / "pretrain.csv").read_bytes() == before


def test_a_plugin_that_cannot_be_imported_says_so(call: Call, tmp_path: Path) -> None:
    (tmp_path / "needs_more.py").write_text("import a_package_that_nobody_has")
    (tmp_path / "json.py").write_text("")
    assert "it cannot be imported" in refused(call("--plugin", tmp_path / "needs_more.py", "doctor"))
    assert "'json' is the name of another module" in refused(call("--plugin", tmp_path / "json.py", "doctor"))
    (tmp_path / "my.maze.py").write_text("")
    assert "has no dot in its name; rename the file" in refused(call("--plugin", tmp_path / "my.maze.py", "doctor"))
    assert "needs a module or a Python file" in refused(call("doctor", "--plugin"))


def test_a_plugin_may_be_named_from_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(plugins, "_loaded", [])
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "plugin_at_home.py").write_text("")
    assert plugins.load_plugins(["--plugin=~/plugin_at_home.py", "doctor"]) == ["doctor"]
    assert plugins.loaded_plugins() == (str(tmp_path / "plugin_at_home.py"),)
    del sys.modules["plugin_at_home"]


# --- an environment of the user's own --------------------------------------------------------------------------------


def test_a_plugins_environment_is_collected_and_learned_with_evaluation_workers(call: Call, tmp_path: Path) -> None:
    task = "gymnasium:SlowEnv-v0"
    collect = ("collect", task, "--transitions", 15, "--workers", 1, "--out", tmp_path / "data")
    status, _, err = call("--plugin", ENVIRONMENT, *collect)
    assert status == 0, err
    (path,) = (tmp_path / "data").iterdir()
    assert len(FrameDataset.open(path)) == 15

    learn = ("downstream", task, "--pretrained", "random-encoder", "--out", tmp_path / "run")
    few = ("--env-steps", 24, "--random-agent-steps", 4, "--eval-interval-env-steps", 24, "--eval-workers", 1)
    status, _, err = call("--plugin", ENVIRONMENT, *learn, *SMALL, *few)
    assert status == 0, err
    assert "MUJOCO" not in err


@pytest.mark.usefixtures("call")
def test_the_doctor_checks_a_plugins_environment() -> None:
    plugins.load_plugin(str(ENVIRONMENT))
    (entry,) = doctor.render_domains(("gymnasium:SlowEnv-v0",), "egl", 100.0)
    assert entry["error"] == ""
    assert entry["agent_step_ms"] > 0

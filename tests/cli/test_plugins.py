"""What a plugin registers, methods and environments, has names in every command and every process."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import FEW, SIZE, SMALL, TASK, Call, refused, rows

from crptpro import doctor, plugins, training
from crptpro.data import FrameDataset
from crptpro.modules import PixelEncoder
from crptpro.objectives import get_method, method_names
from crptpro.pretrained import load_pretrained
from crptpro.training import pretrain

pytestmark = pytest.mark.usefixtures("plugins_are_forgotten")
METHODS = Path(__file__).with_name("own_method.py")
ENVIRONMENT = Path(__file__).with_name("slow_env.py")


def test_a_plugin_registers_a_method_on_an_encoder_of_its_own(call: Call, dataset: Path) -> None:
    assert "slowness" not in method_names()
    own = ("pretrain", dataset, "--out", "out", "--method", "slowness", "--log-interval", 1, "--plugin", METHODS)
    assert call(*own, "--encoder", "width=5")[0] == 0  # images of 16 pixels, as its `config` says
    assert {"slowness", "slowness-active"} <= set(method_names())  # what lists methods lists it
    loaded = load_pretrained("out/encoder")
    assert (loaded.method, loaded.card["training"]["updates"]) == ("slowness", 2)
    assert float(rows("out/pretrain.csv")[-1]["loss_slow"]) > 0

    assert call("finetune", "out/encoder", dataset, "--out", "fine", *FEW, "--plugin", METHODS)[0] == 0
    assert load_pretrained("fine/encoder").label == "slowness-finetune"

    learn = ("downstream", TASK, "--pretrained", "out/encoder", "--out", "down", *SMALL)
    assert call(*learn, "--plugin", METHODS)[0] == 0
    assert call("evaluate", "down/agent", "--episodes", 1, "--plugin", METHODS)[0] == 0
    assert call("probe", "out/encoder", dataset, "--plugin", METHODS)[0] == 0
    assert training.load_agent("down/agent")[0].encoder.conv.weight.shape[0] == 5

    # In Python it is one line.
    loss = get_method("slowness").build(PixelEncoder(image_size=SIZE))
    assert pretrain(loss, dataset, progress=False).updates == 2


def test_a_users_method_explores_with_its_own_reward(call: Call) -> None:
    few = ("--log-interval", 1, "--hidden-dim", 8, "--replay-capacity", 40)
    status, _, err = call("--plugin", METHODS, "pretrain", TASK, "--out", "out", "--method", "slowness-active", *few)
    assert status == 0, err
    loaded = load_pretrained("out/encoder")
    assert (loaded.method, loaded.card["loss"]["config"]["margin"]) == ("slowness-active", 0.5)
    explored = rows("out/explore.csv")
    told = [row["intrinsic_reward/toy-fixed"] for row in explored]
    rewards = [float(reward) for reward in told if reward]
    assert len(rewards) >= len(explored) - 1  # the first row may come before the agent's first update
    assert min(rewards) > 0

    assert call("downstream", TASK, "--pretrained", "out/encoder", "--out", "down", *SMALL)[0] == 0
    assert {row["method"] for row in rows("down/eval.csv")} == {"slowness-active"}


@pytest.mark.parametrize(("name", "message"), [
    ("needs_more.py", "it cannot be imported"),
    ("json.py", "'json' is the name of another module"),
])  # fmt: skip
def test_a_plugin_that_cannot_be_imported_says_so(call: Call, name: str, message: str) -> None:
    Path(name).write_text("import a_package_that_nobody_has")
    assert message in refused(call("--plugin", name, "doctor"))
    assert "needs a module or a Python file" in refused(call("doctor", "--plugin"))


# --- an environment of the user's own --------------------------------------------------------------------------------


def test_a_plugins_environment_is_collected_and_learned_with_evaluation_workers(call: Call) -> None:
    task = "gymnasium:SlowEnv-v0"
    own = ("--plugin", ENVIRONMENT, "--action-repeat", 4)
    status, _, err = call("collect", task, *own, "--transitions", 15, "--workers", 1)
    assert status == 0, err
    (path,) = Path("data").iterdir()
    dataset = FrameDataset.open(path)
    assert (len(dataset), dataset.card["action_repeat"]) == (15, 4)

    few = ("--env-steps", 24, "--random-agent-steps", 4, "--eval-interval-env-steps", 24, "--eval-workers", 1)
    status, _, err = call("downstream", task, "--pretrained", "random-encoder", "--out", "run", *own, *SMALL, *few)
    assert status == 0, err
    assert "MUJOCO" not in err
    assert {row["episode_agent_steps"] for row in rows("run/eval.csv")} == {"5"}
    status, _, err = call("evaluate", "run/agent", "--plugin", ENVIRONMENT, "--episodes", 1, "--csv", "again.csv")
    assert status == 0, err
    assert {row["agent_steps"] for row in rows("again.csv")} == {"5"}  # with the agent's own action repeat
    status, _, err = call("evaluate", "run/agent", "--task", TASK, "--episodes", 1)
    assert status == 1
    assert "takes no action_repeat: an agent step is 1 env step(s), not 4. Use action_repeat=1" in err
    status, _, err = call("evaluate", "run/agent", "--task", TASK, "--episodes", 1, "--action-repeat", 1)
    assert status == 1
    assert f"trained for 1 actions ({task}), {TASK} has 2" in err


@pytest.mark.usefixtures("call")
def test_the_doctor_checks_a_plugins_environment() -> None:
    plugins.load_plugin(str(ENVIRONMENT))
    (entry,) = doctor.render_domains(("gymnasium:SlowEnv-v0",), "egl", 100.0)
    assert entry["error"] == ""
    assert entry["agent_step_ms"] > 0

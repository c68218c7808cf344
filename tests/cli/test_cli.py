"""The command line: its help, its parser, and the whole way from data to an agent."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import SIZE, SMALL, SMALL_DRQ, TASK, Call, refused, rows

from crptpro.cli import main
from crptpro.data import FrameDataset
from crptpro.pretrained import load_pretrained
from crptpro.training import load_agent

COMMANDS = (
    "doctor", "collect", "pretrain", "finetune", "downstream", "drq", "evaluate", "probe", "reproduce", "report",
    "import", "export", "trim",
)  # fmt: skip


# --- help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "named"), [
    ((), ["doctor", "collect", "pretrain", "finetune", "downstream", "drq", "evaluate", "probe"]),
    (("doctor",), ["--domains"]),
    (("collect",), ["--out", "--transitions", "--seed", "--workers", "--quality {exact,fast}", "group letters",
                    "--colors"]),
    (("pretrain",), ["--out", "--method", "--updates", "--batch-size", "--learning-rate", "--precision",
                     "--device", "--logging.wandb", "crptpro 50,", "--explore.env-steps", "proto-rl-c", "--plugin",
                     "--annealing-updates"]),
    (("finetune",), ["--out", "--updates", "--batch-size", "--learning-rate", "--logging.wandb", "PATH PATH"]),
    (("downstream",), ["--pretrained", "random-encoder", "--out", "--env-steps", "--replay-capacity",
                       "--eval-episodes", "--features", "--logging.tensorboard", "(default: 500000)"]),
    (("downstream", "--algorithm", "skill-ddpg"), ["(default: skill-ddpg)", "--skill-ddpg.n-step", "(default: 2000)"]),
    (("drq",), ["--out", "--replay-capacity", "(default: 1000000)", "(default: 0.001)"]),
    (("evaluate",), ["random-policy", "--task", "--episodes", "--csv", "--video", "--colors"]),
    (("report",), ["--out", "--bootstrap-seed", "--replicates", "(default: 2000)", "DIRECTORY/report"]),
    (("probe",), ["random-encoder", "--samples", "--colors", "--csv", "(default: 2000)", "held-out"]),
])  # fmt: skip
def test_help_names_every_argument(call: Call, command: tuple[str, ...], named: list[str]) -> None:
    status, out, err = call(*command, "--help")
    assert (status, err) == (0, "")
    for name in named:
        assert name in out, name


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_every_default_once_and_in_words(
    call: Call, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    text = re.sub(r"[\s│]+", " ", call(command, "--help")[1])
    assert "--help" in text
    assert "(default: )" not in text
    assert not re.findall(r"\(default: [^()]*\) \(default: (?!None\))", text)


def test_drq_offers_nothing_of_other_algorithms(call: Call) -> None:
    text = call("drq", "--help")[1]
    for name in (
        "--algorithm", "skill", "--intrinsic", "--knn-k", "queue", "--transfer-actor", "--features", "proto-rl",
    ):  # fmt: skip
        assert name not in text, name


def test_the_installed_command_is_this_one() -> None:
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="crptpro")
    assert entry.load() is main


@pytest.mark.parametrize(("arguments", "named"), [
    (("downstream", "walker_run"), "--pretrained"),
    (("pretrain", "data/walker"), "--out"),
    (("evaluate", "random-policy", "--episodes", "many"), "many"),
    (("collect", "walker", "--quality", "best"), "best"),
    (("dance",), "dance"),
    (("drq", "walker_run", "--out", "out", "--algorithm", "skill-ddpg"), "--algorithm"),
])  # fmt: skip
def test_what_the_parser_cannot_read_is_named_with_status_2(
    call: Call, arguments: tuple[str, ...], named: str
) -> None:
    status, out, err = call(*arguments)
    assert status == 2
    assert out == ""
    assert named in err
    assert "Traceback" not in err


# --- the whole way ---------------------------------------------------------------------------------------------------


def test_every_command_does_its_part_on_a_world_without_a_simulator(
    call: Call, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = tmp_path / "runs"
    few = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
    first_stage = ("pretrain", dataset, "--out", runs / "pretrain", *few, "--assignment-temperature", 0.05)
    assert call(*first_stage)[0] == 0
    first = load_pretrained(runs / "pretrain" / "encoder")
    assert first.card["training"]["updates"] == 2
    assert first.encoder.image_size == SIZE
    assert len(rows(runs / "pretrain" / "pretrain.csv")) == 2

    assert (
        call("finetune", first_path := runs / "pretrain" / "encoder", dataset, "--out", runs / "fine", *few)[
            0
        ]
        == 0
    )
    tuned = load_pretrained(runs / "fine" / "encoder")
    assert tuned.card["training"]["started_from"] == load_pretrained(first_path).identity()
    assert len(rows(runs / "fine" / "pretrain.csv")) == 2

    down = ("downstream", TASK, "--pretrained", runs / "fine" / "encoder", "--out", runs / "down", *SMALL)
    status, _, err = call(*down)
    assert status == 0
    assert "agent: " in err
    _, card = load_agent(runs / "down" / "agent")
    assert card["pretrained"] == tuned.identity()
    evaluations = rows(runs / "down" / "eval.csv")
    assert [row["env_steps"] for row in evaluations] == ["0", "20", "40", "60"]

    # The same command again finds everything done.
    for command, record in ((first_stage, "pretrain/pretrain.csv"), (down, "down/eval.csv")):
        before = (runs / record).read_bytes()
        assert call(*command)[0] == 0
        assert (runs / record).read_bytes() == before

    # An agent acts in its own kind of world, and is not taken for an encoder.
    status, out, _ = call(
        "evaluate", runs / "down" / "agent", "--episodes", 2, "--csv", runs / "new" / "a.csv"
    )
    assert status == 0
    assert out.startswith(f"{TASK}: ")
    assert "over 2 episodes" in out
    table = rows(runs / "new" / "a.csv")
    assert [(row["task"], row["episode"], row["agent_steps"]) for row in table] == [
        (TASK, "0", "10"),
        (TASK, "1", "10"),
    ]
    with monkeypatch.context() as inside:
        inside.chdir(runs / "down" / "agent")
        assert call("evaluate", ".", "--episodes", 2)[:2] == (0, out)
        inside.chdir(runs / "pretrain" / "encoder")
        assert call("finetune", ".", dataset, "--out", runs / "again", *few)[0] == 0
    line = refused(
        call("downstream", TASK, "--pretrained", runs / "down" / "agent", "--out", tmp_path / "out")
    )
    assert "no pretrained encoder" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("command", "pretrained", "updates"), [
    (("drq",), None, "48"),
    (("downstream", "--algorithm=skill-ddpg", "--pretrained", "random-encoder", "--skill-ddpg.skill", 3),
     "random-encoder", "24"),
])  # fmt: skip
def test_the_other_algorithms_leave_agents_that_evaluate(
    call: Call, tmp_path: Path, command: tuple[object, ...], pretrained: str | None, updates: str
) -> None:
    small = SMALL_DRQ if command[0] == "drq" else SMALL
    status, _, err = call(command[0], TASK, *command[1:], "--out", tmp_path / "run", *small)
    assert status == 0, err
    assert rows(tmp_path / "run" / "eval.csv")[-1]["updates"] == updates
    _, card = load_agent(tmp_path / "run" / "agent")
    assert (card["pretrained"] or "None").split(":")[0] == str(pretrained)
    status, out, _ = call("evaluate", tmp_path / "run" / "agent", "--episodes", 1)
    assert status == 0
    assert out.startswith(f"{TASK}: ")


@pytest.mark.parametrize(("arguments", "message"), [
    (("collect", "walkr", "--out", "data"), "Nearest: walker"),
    (("evaluate", "random-policy"), "name one with --task"),
])  # fmt: skip
def test_a_real_process_ends_with_the_same_line(
    tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    command = [sys.executable, "-c", "from crptpro.cli import main; main()", *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert message in refused((done.returncode, done.stdout, done.stderr))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.gl
@pytest.mark.slow
def test_collect_pretrain_downstream_and_evaluate_on_a_real_domain(call: Call, tmp_path: Path) -> None:
    data, runs = tmp_path / "data", tmp_path / "runs"
    fast = ("--quality", "fast")
    repeat = ("--action-repeat", 4)
    assert (
        call("collect", "cartpole", "--out", data, "--transitions", 20, "--workers", 1, *fast, *repeat)[0]
        == 0
    )
    assert FrameDataset.open(data / "cartpole").card["action_repeat"] == 4
    assert call("pretrain", data / "cartpole", "--out", runs / "p", "--updates", 2, "--batch-size", 4)[0] == 0
    down = (
        "downstream",
        "cartpole_balance",
        "--pretrained",
        runs / "p" / "encoder",
        "--out",
        runs / "d",
        *fast,
        *repeat,
    )
    assert call(*down, *SMALL)[0] == 0
    evaluations = rows(runs / "d" / "eval.csv")
    assert [(row["env_steps"], row["episode_agent_steps"]) for row in evaluations] == [
        ("0", "250"),
        ("60", "250"),
    ]
    assert all(0 <= float(row["episode_return"]) <= 1000 for row in evaluations)
    status, out, _ = call("evaluate", runs / "d" / "agent", "--episodes", 1, "--csv", runs / "returns.csv")
    assert status == 0
    assert rows(runs / "returns.csv")[0]["agent_steps"] == "250"
    assert float(rows(runs / "returns.csv")[0]["episode_return"]) == pytest.approx(
        float(out.split(":")[1].split("±")[0]), abs=0.1
    )
    line = refused(call("evaluate", runs / "d" / "agent", "--task", "gymnasium:Reacher-v5", "--episodes", 1))
    assert "trained for 1 actions (cartpole_balance), gymnasium:Reacher-v5 has 2" in line

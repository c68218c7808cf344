"""The command line: its help, its parser, and the whole way from data to an agent."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import SIZE, SMALL, TASK, Call, refused, rows, toy_dataset
from toy_env import PoisonedEnv, fixed_length

from crptpro.cli import main
from crptpro.data import FrameDataset
from crptpro.domains import Domain, register_domain
from crptpro.pretrained import load_pretrained
from crptpro.training import load_agent

COMMANDS = ("doctor", "collect", "pretrain", "finetune", "downstream", "evaluate", "probe", "reproduce", "report")


# --- help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "named"), [
    ((), COMMANDS),
    (("collect",), ["--out", "--transitions", "--quality {exact,fast}", "group letters", "--colors"]),
    (("pretrain",), ["--method", "--updates", "--batch-size", "--precision", "--loss", "crptpro 50,"]),
    (("pretrain", "--method", "apt-c"), ["--env-steps", "--hidden-dim"]),
    (("finetune",), ["--out", "--updates", "--batch-size", "--logging.wandb"]),
    (("downstream",), ["--pretrained", "random-encoder", "drq", "--replay-capacity", "--features", "500,000"]),
    (("evaluate",), ["random-policy", "--task", "--episodes", "--csv", "--video", "--colors"]),
    (("report",), ["--out"]),
    (("probe",), ["random-encoder", "--samples", "--csv", "held-out"]),
])  # fmt: skip
def test_help_names_every_argument(call: Call, command: tuple[str, ...], named: list[str]) -> None:
    status, out, err = call(*command, "--help")
    assert (status, err) == (0, "")
    for name in named:
        assert name in out, name


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_every_default_once(call: Call, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    text = re.sub(r"[\s│]+", " ", call(command, "--help")[1])
    assert "--help" in text
    assert "(default: )" not in text
    assert not re.findall(r"\(default: [^()]*\) \(default: (?!None\))", text)


def test_the_installed_command_is_this_one() -> None:
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="crptpro")
    assert entry.load() is main


@pytest.mark.parametrize(("arguments", "named"), [
    (("downstream", "walker_run"), "--pretrained"),
    (("pretrain", "data/walker"), "--out"),
    (("evaluate", "random-policy", "--episodes", "many"), "many"),
    (("collect", "walker", "--quality", "best"), "best"),
    (("dance",), "dance"),
])  # fmt: skip
def test_arguments_that_the_parser_cannot_read_are_named_with_status_2(
    call: Call, arguments: tuple[str, ...], named: str
) -> None:
    status, out, err = call(*arguments)
    assert status == 2
    assert out == ""
    assert named in err
    assert "Traceback" not in err


# --- the whole way ---------------------------------------------------------------------------------------------------


def test_every_command_works_on_an_environment_without_a_simulator(
    call: Call, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = tmp_path / "runs"
    first_path, tuned_path, agent = (runs / name for name in ("pretrain/encoder", "fine/encoder", "down/agent"))
    few = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
    first_stage = ("pretrain", dataset, "--out", runs / "pretrain", *few, "--loss", "assignment_temperature=0.05")
    assert call(*first_stage)[0] == 0
    first = load_pretrained(first_path)
    assert first.card["training"]["updates"] == 2
    assert first.encoder.image_size == SIZE
    assert len(rows(runs / "pretrain" / "pretrain.csv")) == 2

    assert call("finetune", first_path, dataset, "--out", runs / "fine", *few)[0] == 0
    tuned = load_pretrained(tuned_path)
    assert tuned.card["training"]["started_from"] == first.identity()
    assert len(rows(runs / "fine" / "pretrain.csv")) == 2

    down = ("downstream", TASK, "--pretrained", tuned_path, "--out", runs / "down", *SMALL)
    status, _, err = call(*down)
    assert status == 0
    assert "agent: " in err
    assert load_agent(agent)[1]["pretrained"] == tuned.identity()
    assert [row["env_steps"] for row in rows(runs / "down" / "eval.csv")] == ["0", "20", "40", "60"]

    # The same command again finds everything done.
    for command, record in ((first_stage, "pretrain/pretrain.csv"), (down, "down/eval.csv")):
        before = (runs / record).read_bytes()
        assert call(*command)[0] == 0
        assert (runs / record).read_bytes() == before

    # An agent acts in its own kind of environment, and is not taken for an encoder.
    status, out, _ = call("evaluate", agent, "--episodes", 2, "--csv", runs / "new" / "a.csv")
    assert status == 0
    assert out.startswith(f"{TASK}: ")
    assert "over 2 episodes" in out
    table = [(row["task"], row["episode"], row["agent_steps"]) for row in rows(runs / "new" / "a.csv")]
    assert table == [(TASK, "0", "10"), (TASK, "1", "10")]
    with monkeypatch.context() as inside:
        inside.chdir(agent)
        assert call("evaluate", ".", "--episodes", 2)[:2] == (0, out)
        inside.chdir(first_path)
        assert call("finetune", ".", dataset, "--out", runs / "again", *few)[0] == 0
    line = refused(call("downstream", TASK, "--pretrained", agent, "--out", tmp_path / "out"))
    assert "is a 'crptpro-agent'" in line
    assert not (tmp_path / "out").exists()


def test_results_are_written_before_they_are_printed(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cannot_show(text: str) -> None:
        raise UnicodeEncodeError("ascii", text, 0, 1, "a terminal of old")

    monkeypatch.setattr("crptpro.cli.print", cannot_show, raising=False)
    file = tmp_path / "a.csv"
    with pytest.raises(UnicodeEncodeError):
        call("evaluate", "random-policy", "--task", TASK, "--episodes", 2, "--csv", file)
    assert [row["episode"] for row in rows(file)] == ["0", "1"]


def test_a_reward_that_is_not_finite_ends_an_evaluation_and_keeps_its_finished_episodes(
    call: Call, tmp_path: Path
) -> None:
    def make(*, seed: int, image_size: int) -> PoisonedEnv:
        return PoisonedEnv(fixed_length, seed=seed, image_size=image_size)

    register_domain(Domain("poisoned", "poisoned_go", make=make))
    file = tmp_path / "a.csv"
    line = refused(call("evaluate", "random-policy", "--task", "poisoned_go", "--episodes", 4, "--csv", file))
    assert "'poisoned_go' returned reward" in line
    assert [row["episode"] for row in rows(file)] == ["0"]


@pytest.mark.parametrize("pretrained", ["drq", "random-encoder"])
def test_the_controls_leave_agents_that_evaluate(call: Call, tmp_path: Path, pretrained: str) -> None:
    run = tmp_path / "run"
    status, _, err = call("downstream", TASK, "--pretrained", pretrained, "--out", run, *SMALL)
    assert status == 0, err
    assert {row["method"] for row in rows(run / "eval.csv")} == {pretrained}
    status, out, _ = call("evaluate", run / "agent", "--episodes", 1)
    assert status == 0
    assert out.startswith(f"{TASK}: ")


def test_an_untrained_encoder_is_written_like_any_other(call: Call, dataset: Path, tmp_path: Path) -> None:
    for method in ("random-encoder", "random-encoder-standardised"):
        assert call("pretrain", dataset, "--method", method, "--out", tmp_path / method)[0] == 0
        loaded = load_pretrained(tmp_path / method / "encoder")
        assert (loaded.method, loaded.encoder.image_size) == (method, SIZE)
    other = ("pretrain", dataset, "--method", "random-encoder", "--out", tmp_path / "other")
    assert call(*other, "--encoder", "init=kaiming")[0] == 0
    assert load_pretrained(tmp_path / "other" / "encoder").encoder.config["init"] == "kaiming"
    assert "is not trained and has no loss" in refused(call(*other, "--loss", "num_prototypes=8"))


def test_a_real_process_ends_with_the_same_line(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from crptpro.cli import main; main()", "collect", "walkr", "--out", "data"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False)
    assert "Nearest: walker" in refused((done.returncode, done.stdout, done.stderr))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.gl
@pytest.mark.slow
def test_collect_pretrain_downstream_and_evaluate_on_a_real_domain(call: Call, tmp_path: Path) -> None:
    data, runs = tmp_path / "data", tmp_path / "runs"
    fast = ("--quality", "fast", "--action-repeat", 4)
    assert call("collect", "cartpole", "--out", data, "--transitions", 20, "--workers", 1, *fast)[0] == 0
    assert FrameDataset.open(data / "cartpole").card["action_repeat"] == 4
    assert call("pretrain", data / "cartpole", "--out", runs / "p", "--updates", 2, "--batch-size", 4)[0] == 0
    down = ("downstream", "cartpole_balance", "--pretrained", runs / "p" / "encoder", "--out", runs / "d")
    assert call(*down, *fast, *SMALL, "--eval-interval-env-steps", 60)[0] == 0
    evaluations = rows(runs / "d" / "eval.csv")
    assert [row["env_steps"] for row in evaluations] == ["0", "60"]
    assert {row["episode_agent_steps"] for row in evaluations} == {"250"}
    assert all(0 <= float(row["episode_return"]) <= 1000 for row in evaluations)
    line = refused(call("evaluate", runs / "d" / "agent", "--task", "gymnasium:Reacher-v5", "--episodes", 1))
    assert "trained for 1 actions (cartpole_balance), gymnasium:Reacher-v5 has 2" in line


# --- what is refused: one line, a status, and nothing left behind -----------------------------------------------------


@pytest.mark.parametrize(("arguments", "message"), [
    (("collect", "cartpole", "walkr"), r"no domain or task 'walkr'\. Nearest: walker"),
    (("collect",), r"Name at least one domain"),
    (("collect", "cartpole", "--seed", "-1"), r"`seed` must be at least 0, got -1"),
    (("pretrain",), r"at least one dataset directory"),
    (("pretrain", "absent"), r"absent"),
    (("pretrain", "walker", "--method", "proto-rl"), r"no method 'proto-rl'\. .*proto-rl-"),
    (("pretrain", "walker"), r"walker is no directory.*`crptpro collect walker`"),
    (("pretrain", "data/walker", "--method", "proto-rl-c"), r"no domain or task 'data/walker'"),
    (("pretrain", "walkr", "--method", "apt-c"), r"'walkr'\. Nearest: walker"),
    (("pretrain", "--method", "becl"), r"at least one domain, task or group \(A, B, C, D\)"),
    (("pretrain", "A", "--method", "apt-s"), r"one domain, got 3 \(cheetah, walker, quadruped\)"),
    (("pretrain", TASK, "--method", "proto-rl-c", "--queue-size", "7"), r"queue_size.* multiple"),
    (("finetune", "absent", "absent"), r"absent"),
    (("downstream", "walker_rum", "--pretrained", "random-encoder"), r"'walker_rum'\. Nearest: walker_run"),
    (("downstream", TASK, "--pretrained", "absent"), r"absent does not exist"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--device", "abacus"), r"'abacus' cannot be used"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--discount", "2"), r"discount.*got 2"),
    (("--plugin", "absent.py", "pretrain", TASK), r"--plugin absent\.py: there is no such file"),
    (("collect", TASK, "--out="), r"empty: --out"),
    (("downstream", TASK, "--pretrained", "drq", "--out", ""), r"empty: --out"),
    (("evaluate", "random-policy"), r"name one, e\.g\. --task"),
    (("evaluate", "absent"), r"absent does not exist"),
    (("evaluate", "random-policy", "--task", "walker_rum"), r"Nearest: walker_run"),
    (("evaluate", "random-policy", "--task", TASK, "--episodes", "0"), r"at least 1, got 0"),
    (("evaluate", "random-policy", "--task", TASK, "--colors", "reversed_background"), r"colors='reversed_image'"),
])  # fmt: skip
def test_an_impossible_request_leaves_nothing_behind(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    written = {"evaluate": ("--csv", "out/a.csv")}.get(arguments[0], ("--out", "out"))
    line = refused(call(*arguments, *(() if arguments[-1] in ("--out=", "") else written)))
    assert re.search(message, line), line
    assert list(tmp_path.iterdir()) == []


def test_a_home_directory_is_expanded_also_where_the_shell_leaves_it(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    assert call("collect", TASK, "--out=~/data", "--transitions", 10, "--workers", 1)[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


def test_datasets_that_do_not_fit_are_refused(call: Call, dataset: Path, encoder: Path, tmp_path: Path) -> None:
    other, out = toy_dataset(tmp_path / "data" / "other", SIZE + 2), tmp_path / "out"
    line = refused(call("pretrain", dataset, other, "--out", out))
    assert f"{dataset} has 16 px" in line
    assert f"{other} has 18 px" in line
    assert "image_size 16, not 18" in refused(call("finetune", encoder, other, "--out", out))
    file = next(dataset.rglob("pixels.memmap"))
    os.truncate(file, file.stat().st_size - 1)
    assert str(file) in refused(call("pretrain", dataset, "--out", out))
    assert not out.exists()


def test_a_run_with_other_settings_is_not_continued(call: Call, dataset: Path, tmp_path: Path) -> None:
    common = ("pretrain", dataset, "--out", tmp_path / "out", "--updates", 2, "--log-interval", 1)
    assert call(*common, "--batch-size", 4)[0] == 0
    before = (tmp_path / "out" / "pretrain.csv").read_bytes()
    assert "batch_size was 4, now 6" in refused(call(*common, "--batch-size", 6))
    assert (tmp_path / "out" / "pretrain.csv").read_bytes() == before


def test_mirrors_begin_with_the_run_and_get_its_record(
    call: Call, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import wandb

    monkeypatch.setattr(wandb, "init", lambda **_: pytest.fail("W&B was asked for a run"))
    refusal = ("downstream", TASK, "--pretrained", "random-encoder", "--discount", "2", "--out", tmp_path / "no")
    refused(call(*refusal, "--logging.wandb", "offline", "--logging.tensorboard"))
    assert not (tmp_path / "no").exists()
    few = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
    assert call("pretrain", dataset, "--out", tmp_path / "out", *few, "--logging.tensorboard")[0] == 0
    assert list((tmp_path / "out" / "tensorboard").iterdir())
    assert len(rows(tmp_path / "out" / "pretrain.csv")) == 2
    run = tmp_path / "run"  # one with a mirror is reported like any other
    common = ("downstream", TASK, "--pretrained", "random-encoder", "--out", run, *SMALL)
    assert call(*common, "--logging.tensorboard")[0] == 0
    settings = json.loads((run / "config.json").read_text())["config"]
    assert (settings["task"], settings["learning_rate"]) == (TASK, 1e-4)
    assert settings["pretrained"].startswith("random-encoder")
    assert call("report", run)[0] == 0

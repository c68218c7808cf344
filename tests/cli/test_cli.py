"""The command line: its help, its parser, and the whole way from data to an agent."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import pandas as pd
import pytest
from command import FEW, SIZE, SMALL, TASK, Call, refused, rows, toy_dataset
from toy_env import PoisonedEnv, fixed_length, random_episode, write_dataset

from crptpro import plugins
from crptpro.cli import main
from crptpro.domains import Domain, register_domain
from crptpro.envs import make_env
from crptpro.pretrained import SHIPPED, load_pretrained
from crptpro.training import load_agent

# --- help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "named"), [
    ((), ["doctor", "collect", "pretrain", "finetune", "downstream", "evaluate", "probe", "reproduce", "report"]),
    (("doctor",), ["--domains"]),
    (("collect",), ["--out", "--transitions", "--quality {exact,fast}", "group letters", "--colors"]),
    (("pretrain",), ["--method", "--updates", "--batch-size", "--precision", "--loss", "crptpro 50,"]),
    (("pretrain", "--method", "apt-c"), ["--env-steps", "--hidden-dim"]),
    (("finetune",), ["--out", "--updates", "--batch-size", "--logging.wandb"]),
    (("downstream",), ["--pretrained", "random-encoder", "drq", "--replay-capacity", "--features", "500,000"]),
    (("evaluate",), ["random-policy", "--task", "--episodes", "--csv", "--video", "--colors"]),
    (("reproduce",), ["EXPERIMENT", "--scale {tiny,small,paper}", "--dry-run"]),
    (("report",), ["--out"]),
    (("probe",), ["random-encoder", "--samples", "--csv", "held-out"]),
])  # fmt: skip
def test_help_names_every_argument_and_says_every_default_once(
    call: Call, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...], named: list[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    status, out, err = call(*command, "--help")
    assert (status, err) == (0, "")
    text = re.sub(r"[\s│]+", " ", out)
    assert [name for name in named if name not in text] == []
    assert "(default: )" not in text
    assert not re.findall(r"\(default: [^()]*\) \(default: ", text)


def test_the_installed_command_is_this_one() -> None:
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="crptpro")
    assert entry.load() is main


@pytest.mark.parametrize(("arguments", "named"), [
    (("downstream", "walker_run"), "--pretrained"),
    (("pretrain", "data/walker"), "--out"),
    (("evaluate", "random-policy", "--episodes", "many"), "many"),
    (("collect", "walker", "--quality", "best"), "best"),
    (("dance",), "dance"),
    (("collect", "walker", "--transitions", "1.5"), "'1.5' is not a whole number"),
])  # fmt: skip
def test_arguments_that_the_parser_cannot_read_are_named_with_status_2(
    call: Call, arguments: tuple[str, ...], named: str
) -> None:
    status, out, err = call(*arguments)
    assert status == 2
    assert out == ""
    assert named in err
    assert "Traceback" not in err


def test_the_version_is_that_of_the_distribution(call: Call) -> None:
    assert call("--version")[:2] == (0, f"crptpro {importlib.metadata.version('crptpro')}\n")


# --- the whole way ---------------------------------------------------------------------------------------------------


def test_every_command_works_without_a_simulator(call: Call, dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first_path, tuned_path, agent, file = map(Path, ("first/encoder", "tuned/encoder", "down/agent", "new/a.csv"))
    first_stage = ("pretrain", dataset, "--out", "first", *FEW, "--loss", "assignment_temperature=0.05")
    assert call(*first_stage, "--logging.tensorboard")[0] == 0
    first = load_pretrained(first_path)
    assert first.card["training"]["updates"] == 2
    assert first.encoder.image_size == SIZE
    assert len(rows("first/pretrain.csv")) == 2
    assert list(Path("first/tensorboard").iterdir())

    assert call("finetune", first_path, dataset, "--out", "tuned", *FEW)[0] == 0
    tuned = load_pretrained(tuned_path)
    assert tuned.card["training"]["started_from"] == first.identity()
    assert len(rows("tuned/pretrain.csv")) == 2

    down = ("downstream", TASK, "--pretrained", tuned_path, "--out", "down", *SMALL)
    status, _, err = call(*down, "--logging.tensorboard")
    assert status == 0
    assert "agent: " in err
    assert load_agent(agent)[1]["pretrained"] == tuned.identity()
    assert [row["env_steps"] for row in rows("down/eval.csv")] == ["0", "20", "40", "60"]
    settings = json.loads(Path("down/config.json").read_text())["config"]
    assert (settings["task"], settings["learning_rate"]) == (TASK, 1e-4)
    assert call("report", "down")[0] == 0

    # The same command again finds everything done; one with other settings is refused.
    for command, record in ((first_stage, Path("first/pretrain.csv")), (down, Path("down/eval.csv"))):
        before = record.read_bytes()
        assert call(*command)[0] == 0
        assert "batch_size was 4, now 6" in refused(call(*command, "--batch-size", 6))
        assert record.read_bytes() == before

    # An agent acts in its own kind of environment, and is not taken for an encoder.
    assert "Did you mean" in refused(call("evaluate", "down"))
    status, out, _ = call("evaluate", agent, "--episodes", "2e0", "--csv", file)
    assert status == 0
    assert out.startswith(f"{TASK}: ")
    assert "over 2 episodes" in out
    assert [(row["task"], row["agent_steps"]) for row in rows(file)] == [(TASK, "10")] * 2
    with monkeypatch.context() as inside:
        cameras: list[Any] = []
        inside.setattr("crptpro.cli.make_env", lambda task, **own: cameras.append(task.camera) or make_env(task, **own))
        card = (agent / "card.json").read_text()
        (agent / "card.json").write_text(json.dumps({**json.loads(card), "camera": 5}))
        assert call("evaluate", agent, "--episodes", 2)[:2] == (0, out)
        (agent / "card.json").write_text(card)
        assert cameras == [5]
    assert "is a 'crptpro-agent'" in refused(call("downstream", TASK, "--pretrained", agent, "--out", "other"))
    assert not Path("other").exists()
    with monkeypatch.context() as inside:
        inside.chdir(agent)
        assert call("evaluate", ".", "--episodes", 2)[:2] == (0, out)
    monkeypatch.chdir(first_path)
    assert call("finetune", ".", dataset, "--out", "../../again", *FEW)[0] == 0


def test_a_reward_that_is_not_finite_ends_an_evaluation_and_keeps_its_finished_episodes(call: Call) -> None:
    def make(*, seed: int, image_size: int) -> PoisonedEnv:
        return PoisonedEnv(fixed_length, seed=seed, image_size=image_size)

    register_domain(Domain("poisoned", "poisoned_go", make=make))
    line = refused(call("evaluate", "random-policy", "--task", "poisoned_go", "--episodes", 4, "--csv", "a.csv"))
    assert "'poisoned_go' returned reward" in line
    assert [row["episode"] for row in rows("a.csv")] == ["0"]


def test_the_first_episode_is_written_as_a_video_after_its_score(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    own = ("evaluate", "random-policy", "--task", TASK, "--episodes", 2, "--video")
    status, scores, err = call(*own, "new/first.mp4")
    assert status == 0, err
    with imageio.get_reader("new/first.mp4", format="FFMPEG") as video:
        assert video.count_frames() == 10  # one per decision of the episode
        size = 4 * make_env(TASK, seed=0).observation_spec["pixels"].shape[-1]
        assert video.get_data(0).shape == (size, size, 3)

    monkeypatch.setattr("imageio_ffmpeg.write_frames", lambda *_, **__: Path("absent/file").read_bytes())
    status, out, err = call(*own, "new/second.mp4")
    assert (status, out) == (1, scores)  # the episodes are not lost
    assert "error: --video new/second.mp4 was not written" in err
    assert [path.name for path in Path("new").iterdir()] == ["first.mp4"]


def test_a_video_that_cannot_be_written_is_refused_before_any_episode(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crptpro.training.evaluate", lambda *_, **__: pytest.fail("an episode ran"))
    own = ("evaluate", "random-policy", "--task", TASK, "--video")
    assert "the name of an MP4 ends in .mp4" in refused(call(*own, "first.gif"))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert "pip install 'crptpro[video]'" in refused(call(*own, "first.mp4"))
    assert list(Path().iterdir()) == []


def test_an_untrained_encoder_is_written_like_any_other(call: Call, dataset: Path) -> None:
    for method in ("random-encoder", "random-encoder-standardised"):
        assert call("pretrain", dataset, "--method", method, "--out", method)[0] == 0
        loaded = load_pretrained(f"{method}/encoder")
        assert (loaded.method, loaded.encoder.image_size) == (method, SIZE)
    other = ("pretrain", dataset, "--method", "random-encoder", "--out", "other")
    assert call(*other, "--encoder", "init=kaiming")[0] == 0
    assert load_pretrained("other/encoder").encoder.config["init"] == "kaiming"
    assert "is not trained and has no loss" in refused(call(*other, "--loss", "num_prototypes=8"))
    for ignored in (("--updates", 7), ("--device", "cuda"), ("--logging.wandb", "online")):
        assert "only --seed and --encoder apply" in refused(call(*other, *ignored))


def test_a_real_process_ends_with_the_same_line(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from crptpro.cli import main; main()", "collect", "walkr", "--out", "data"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False)
    assert "Nearest: walker" in refused((done.returncode, done.stdout, done.stderr))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.gl
def test_collect_pretrain_and_downstream_on_a_real_domain(call: Call) -> None:
    fast = ("--quality", "fast", "--action-repeat", 4)
    assert call("collect", "cartpole", "--out", "data", "--transitions", 20, "--workers", 1, *fast)[0] == 0
    assert call("pretrain", "data/cartpole", "--out", "first", *FEW)[0] == 0
    assert load_pretrained("first/encoder").card["training"]["datasets"][0]["action_repeat"] == 4
    down = ("downstream", "cartpole_balance", "--pretrained", "first/encoder", "--out", "down", *SMALL, *fast)
    assert call(*down, "--eval-interval-env-steps", 60)[0] == 0
    found = rows("down/eval.csv")
    assert [(row["env_steps"], row["episode_agent_steps"]) for row in found] == [("0", "250"), ("60", "250")]
    assert all(0 <= float(row["episode_return"]) <= 1000 for row in found)


def table(out: str) -> list[list[str]]:
    return [line.split() for line in out.splitlines()[1:]]


def test_an_encoder_and_the_control_are_probed_with_table_and_csv(call: Call, dataset: Path, encoder: Path) -> None:
    status, out, _ = call("probe", encoder, dataset, "--csv", "new/probe.csv")
    assert status == 0
    assert [line[:5] for line in table(out)] == [["crptpro", "toy", "yes", "normal", z] for z in ("features", "z")]
    found = pd.read_csv("new/probe.csv")
    own = found[found["embedding"] == "z"].fillna("")
    assert list(zip(own["measure"], own["coordinate"])) == [
        *(("r2_position", f"qpos[{index}]") for index in range(4)),
        *(("r2_velocity", f"qvel[{index}]") for index in range(3)),
        *((name, "") for name in ("r2_position", "r2_velocity", "effective_rank", "mean_cosine")),
    ]
    about = found[["encoder", "method", "samples", "held_out_episodes"]].drop_duplicates()
    assert about.to_numpy().tolist() == [[str(encoder), "crptpro", 60, 2]]
    assert float(table(out)[1][5]) == pytest.approx(own["value"].iloc[-4], abs=1e-4)

    status, out, _ = call("probe", "random-encoder", dataset, "--samples", 40)
    assert status == 0
    assert [line[:3] for line in table(out)] == [["random-encoder", "toy", "no"]] * 2


# --- what is refused: one line, a status, and nothing left behind -----------------------------------------------------


@pytest.mark.parametrize(("arguments", "message"), [
    (("collect", "cartpole", "walkr"), r"no domain or task 'walkr'\. Nearest: walker"),
    (("collect",), r"Name at least one domain"),
    (("collect", "cartpole", "--seed", "-1"), r"`seed` must be at least 0, got -1"),
    (("pretrain",), r"at least one dataset directory"),
    (("pretrain", "walker", "--method", "proto-rl"), r"no method 'proto-rl'\. .*proto-rl-"),
    (("pretrain", "walker"), r"walker is not a directory.*`crptpro collect walker`"),
    (("pretrain", "data/walker", "--method", "proto-rl-c"), r"no domain or task 'data/walker'"),
    (("pretrain", os.path.dirname(__file__), "--method", "proto-rl-c"), r"proto-rl-c explores and reads no dataset"),
    (("pretrain", str(SHIPPED / "group-a")), r"group-a has the format 'crptpro-pretrained': it is not a dataset"),
    (("pretrain", "--method", "becl"), r"at least one domain, task or group \(A, B, C, D\)"),
    (("pretrain", "A", "--method", "apt-s"), r"one domain, got 3 \(cheetah, walker, quadruped\)"),
    (("pretrain", TASK, "--method", "proto-rl-c", "--queue-size", "7"), r"queue_size.* multiple"),
    (("pretrain", "A", "--method", "apt-c", "--encoder", "widht=1"), r"An encoder has no option widht; it has "),
    (("pretrain", "A", "--method", "apt-c", "--encoder", "channels=32"), r"channels and strides must be sequences"),
    (("pretrain", "A", "--method", "proto-rl-c", "--loss", "offset=abc"), r"`offset` must be a number, got 'abc'"),
    (("pretrain", "A", "--method", "proto-rl-c", "--loss", "temperature=None"), r"`temperature` must be a number"),
    (("downstream", TASK, "--pretrained", "drq", "--initial-temperature", "0"), r"`initial_temperature` must be pos"),
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
    (("evaluate", "random-policy", "--task", TASK, "--episodes", "0"), r"at least 1, got 0"),
    (("evaluate", "random-policy", "--task", TASK, "--action-repeat", "0"), r"`action_repeat` must be at"),
    (("evaluate", "random-policy", "--task", TASK, "--colors", "reversed_background"), r"colors='reversed_image'"),
    (("probe", "random-encoder", "absent"), r"absent is not a directory"),
    (("probe", "random-encoder", "absent", "--samples", "0"), r"at least 1, got 0"),
    (("probe", "random-encoder", "absent", "--device", "abacus"), r"'abacus' cannot be used"),
])  # fmt: skip
def test_an_impossible_request_leaves_nothing_behind(call: Call, arguments: tuple[str, ...], message: str) -> None:
    written = ("--csv", "out/a.csv") if arguments[0] in ("evaluate", "probe") else ("--out", "out")
    line = refused(call(*arguments, *(() if arguments[-1] in ("--out=", "") else written)))
    assert re.search(message, line), line
    assert list(Path().iterdir()) == []


def test_a_home_directory_is_expanded_where_the_shell_leaves_it(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    home = Path("home").absolute()
    home.mkdir()
    (home / "plugin_at_home.py").write_text("")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("HOME", str(home))
    collect = ("collect", TASK, "--out=~/data", "--transitions", 10, "--workers", 1)
    assert call("--plugin=~/plugin_at_home.py", *collect)[0] == 0
    assert plugins.loaded_plugins() == (str(home / "plugin_at_home.py"),)
    del sys.modules["plugin_at_home"]
    assert list(Path().absolute().iterdir()) == [home]


def test_datasets_that_do_not_fit_are_refused(call: Call, dataset: Path, encoder: Path) -> None:
    other = toy_dataset(Path("other"), SIZE + 2)
    line = refused(call("pretrain", dataset, other, "--out", "out"))
    assert f"{dataset} has 16 px" in line
    assert f"{other} has 18 px" in line
    assert "(9, 18, 18); the encoder takes (9, 16, 16)" in refused(call("finetune", encoder, other, "--out", "out"))
    file = next(dataset.rglob("pixels.memmap"))
    os.truncate(file, file.stat().st_size - 1)
    assert str(file) in refused(call("pretrain", dataset, "--out", "out"))
    assert not Path("out").exists()


def test_mirrors_begin_with_the_run(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wandb.init", lambda **_: pytest.fail("W&B was asked for a run"))
    refusal = ("downstream", TASK, "--pretrained", "random-encoder", "--discount", "2", "--out", "out")
    refused(call(*refusal, "--logging.wandb", "offline", "--logging.tensorboard"))
    named = (*refusal[:4], "--out", "out", "--logging.wandb-project", "mine")
    assert "needs --logging.wandb" in refused(call(*named))
    assert not Path("out").exists()


def test_a_probe_that_is_refused_keeps_what_it_has_measured(call: Call, encoder: Path, dataset: Path) -> None:
    file, small, stateless = map(Path, ("probe.csv", "small", "stateless"))
    assert "[*, 9, 16, 16], got (60, 9, 8, 8)" in refused(call("probe", encoder, toy_dataset(small, 8), "--csv", file))
    assert "absent does not exist" in refused(call("probe", "absent", dataset, "--csv", file))
    assert "draw more samples" in call("probe", "random-encoder", dataset, "--samples", 4, "--csv", file)[2]
    assert not file.exists()
    write_dataset(stateless, [random_episode(9, size=SIZE, state=False)])
    status, out, err = call("probe", "random-encoder", dataset, stateless, "--csv", file)
    assert status == 1
    assert "no physical state" in err
    assert [line[:2] for line in table(out)] == [["random-encoder", "toy"]] * 2
    assert len(rows(file)) > 4

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from command import SIZE, SMALL, SMALL_DRQ, TASK, Call, refused, rows, toy_dataset

from crptpro.cli import main
from crptpro.data import FrameDataset
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import load_agent


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(image_size=SIZE), num_prototypes=16, latent_dim=4, hidden_dim=8)
    return save_pretrained(loss, tmp_path / "encoder")


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


# --- refusals: one line, a status, nothing left behind ---------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "message"), [
    (("collect", "cartpole", "walkr"), r"no domain or task 'walkr'\. Nearest: walker"),
    (("collect",), r"Name at least one domain"),
    (("collect", "gymnasium:HalfChetah-v5"), r"HalfChetah.*Nearest: gymnasium:HalfCheetah"),
    (("collect", "cartpole", "--transitions", "0"), r"at least 1, got 0"),
    (("collect", "cartpole", "--action-repeat", "0"), r"action_repeat must be at least 1, got 0"),
    (("collect", "cartpole", "--seed", "-1"), r"`seed` must be from 0 to 4294967295, got -1"),
    (("drq", TASK, "--seed", str(2**32)), r"`seed` must be from 0 to 4294967295, got 4294967296"),
    (("pretrain",), r"at least one dataset directory"),
    (("pretrain", "absent"), r"absent"),
    (("finetune", "absent", "absent"), r"absent"),
    (("downstream", "walker_rum", "--pretrained", "random-encoder"), r"'walker_rum'\. Nearest: walker_run"),
    (("downstream", TASK, "--pretrained", "absent"), r"absent does not exist"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--device", "abacus"), r"'abacus' cannot be used"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--discount", "2"), r"discount.*got 2"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--algorithm", "drq"), r"crptpro drq toy-fixed_go --out"),
    (("drq", "walker_rum"), r"'walker_rum'\. Nearest: walker_run"),
])  # fmt: skip
def test_a_request_that_cannot_be_met_leaves_nothing_behind(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(call(*arguments, "--out", tmp_path / "out"))
    assert re.search(message, line), line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("arguments", "message"), [
    (("random-policy",), "name one with --task"),
    (("absent",), "absent does not exist"),
    (("random-policy", "--task", "walker_rum"), "Nearest: walker_run"),
    (("random-policy", "--task", TASK, "--episodes", "0"), "at least 1, got 0"),
    (("random-policy", "--task", TASK, "--seed", "-1"), "`seed` must be from 0 to 4294967295, got -1"),
    (("random-policy", "--task", TASK, "--colors", "reversed_background"), "colors='reversed_image'"),
])  # fmt: skip
def test_an_evaluation_that_cannot_run_says_why(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused(call("evaluate", *arguments, "--csv", "out/returns.csv"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--csv", "--video"])
def test_what_cannot_be_written_is_refused_before_any_episode(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    asked = ("evaluate", "random-policy", "--task", TASK, option)
    (tmp_path / "file").touch()
    for path, message in (
        (tmp_path, "is a directory"),
        (Path("/dev/null"), "no ordinary file"),
        (tmp_path / "file" / "x", "file is a file"),
    ):
        assert f"{option} {path} " in (line := refused(call(*asked, path)))
        assert message in line
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert f"you may not write to {tmp_path}" in refused(call(*asked, tmp_path / "new" / "x"))


def test_a_video_without_the_extra_is_refused_before_any_episode(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *_: None if name == "imageio_ffmpeg" else find(name, *_)
    )
    line = refused(call("evaluate", "random-policy", "--task", TASK, "--video", tmp_path / "x.mp4"))
    assert "--video needs the `video` extra: pip install 'crptpro[video]'" in line


def test_a_video_that_could_not_be_written_fails_below_the_scores_and_the_table(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crptpro.training.video.can_encode", lambda: True)
    monkeypatch.setattr("crptpro.training.video.write_video", lambda *_: None)
    asked = ("evaluate", "random-policy", "--task", TASK, "--episodes", 1, "--csv", tmp_path / "x.csv")
    status, out, err = call(*asked, "--video", tmp_path / "x.mp4")
    assert status == 1
    assert out.startswith(f"{TASK}: ")
    assert len(rows(tmp_path / "x.csv")) == 1
    assert err.splitlines()[-1].startswith(f"error: --video {tmp_path / 'x.mp4'} was not written")


def test_a_table_for_which_the_disk_is_full_is_named_below_the_scores(call: Call, tmp_path: Path) -> None:
    (tmp_path / f".x.csv.{os.getpid()}.partial").symlink_to("/dev/full")
    asked = ("evaluate", "random-policy", "--task", TASK, "--episodes", 1, "--csv", tmp_path / "x.csv")
    status, out, err = call(*asked)
    assert status == 1
    assert out.startswith(f"{TASK}: ")
    assert err.splitlines()[-1].startswith(
        f"error: The disk is full: {tmp_path / 'x.csv'} cannot be written."
    )
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_dataset_is_named(call: Call, dataset: Path, tmp_path: Path) -> None:
    file = next(dataset.rglob("pixels.memmap"))
    os.truncate(file, file.stat().st_size - 1)
    assert str(file) in refused(call("pretrain", dataset, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("flag", "value", "message"), [
    ("--method", "protto", "Nearest: .*proto|'protto'"),
    ("--updates", "0", "updates.*0"),
    ("--batch-size", "0", "batch_size.*0"),
    ("--learning-rate", "-1", "learning_rate.*-1"),
    ("--log-interval", "0", "log_interval.*0"),
    ("--assignment-temperature", "0", "temperature.*0"),
    ("--annealing-updates", "9", "needs an assignment_temperature"),
    ("--seed", "-1", "`seed`.*got -1"),
])  # fmt: skip
def test_a_setting_that_pretraining_refuses_is_one_line(
    call: Call, dataset: Path, tmp_path: Path, flag: str, value: str, message: str
) -> None:
    line = refused(call("pretrain", dataset, "--out", tmp_path / "out", flag, value))
    assert re.search(message, line), line
    assert not list((tmp_path / "out").rglob("*.csv"))


def test_datasets_of_different_images_are_refused(call: Call, dataset: Path, tmp_path: Path) -> None:
    other = toy_dataset(tmp_path / "data" / "other", SIZE + 2)
    line = refused(call("pretrain", dataset, other, "--out", tmp_path / "out"))
    assert f"{dataset} has 16 px" in line
    assert f"{other} has 18 px" in line
    assert not (tmp_path / "out").exists()


def test_an_encoder_for_other_images_is_refused(call: Call, encoder: Path, tmp_path: Path) -> None:
    other = toy_dataset(tmp_path / "data" / "other", SIZE + 2)
    line = refused(call("finetune", encoder, other, "--out", tmp_path / "out"))
    assert "image_size 16, not 18" in line
    assert not (tmp_path / "out").exists()


def test_a_run_with_other_settings_is_not_continued(call: Call, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    common = ("pretrain", dataset, "--out", out, "--updates", 2, "--log-interval", 1)
    assert call(*common, "--batch-size", 4)[0] == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    line = refused(call(*common, "--batch-size", 6))
    assert "batch_size was 4, now 6" in line
    assert before == {path: path.read_bytes() for path in before}


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

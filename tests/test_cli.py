from __future__ import annotations

import csv
import importlib.metadata
import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from toy_world import FIXED, ToyEnv, fixed_length

from crptpro import domains
from crptpro.cli import main
from crptpro.data import FrameDataset
from crptpro.data.collect_worker import EpisodeRoller
from crptpro.data.collection import DomainCollection
from crptpro.domains import register_domain
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss, SimCLRLoss, registry
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import load_agent

SIZE = 16
TASK = FIXED.task
SMALL = (
    "--env-steps", 60, "--random-agent-steps", 12, "--batch-size", 4, "--replay-capacity", 20,
    "--eval-episodes", 1, "--eval-interval-env-steps", 20, "--checkpoint-interval-env-steps", 20,
    "--log-interval-env-steps", 10, "--queue-size", 512, "--precision", "fp32", "--hidden-dim", 32,
)  # fmt: skip

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Call]:
    """Run the command in this process; returns exit status, standard output and standard error."""
    library = logging.getLogger("crptpro")
    before = library.handlers[:], library.level, library.propagate
    monkeypatch.setattr(domains, "_registered", {})
    register_domain(FIXED)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crptpro", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as stopped:
            status = stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
        return status, *capsys.readouterr()

    yield run
    library.handlers[:], library.propagate = before[0], before[2]
    library.setLevel(before[1])


def refused(result: tuple[int, str, str]) -> str:
    """The one line of a refusal."""
    status, out, err = result
    assert status == 1
    assert out == ""
    assert len(err.splitlines()) == 1, err
    assert err.startswith("error: ")
    return err


def toy_dataset(path: Path, size: int = SIZE) -> Path:
    settings = {"image_size": size, "action_repeat": 2, "camera": 0, "quality": "exact"}
    request = {"domain": path.name, "task": f"{path.name}_go", "seed": 0, "transitions": 27, **settings}
    collection = DomainCollection(path, request, 10)
    roller = EpisodeRoller(lambda: ToyEnv(fixed_length, image_size=size))
    while (job := collection.next_job()) is not None:
        collection.accept(job.episode, roller.roll(job))
    roller.close()
    collection.close()
    return path


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return toy_dataset(tmp_path / "data" / "toy")


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(image_size=SIZE), num_prototypes=16, latent_dim=4, hidden_dim=8)
    return save_pretrained(loss, tmp_path / "encoder")


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


# --- help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "named"), [
    ((), ["doctor", "collect", "pretrain", "finetune", "downstream", "drq", "evaluate", "probe"]),
    (("doctor",), ["--domains"]),
    (("collect",), ["--out", "--transitions", "--seed", "--workers", "--quality {exact,fast}", "group letters",
                    "--colors"]),
    (("pretrain",), ["--out", "--method", "--updates", "--batch-size", "--learning-rate", "--precision",
                     "--device", "--logging.wandb", "50,000"]),
    (("finetune",), ["--out", "--updates", "--batch-size", "--learning-rate", "--logging.wandb", "PATH PATH"]),
    (("downstream",), ["--pretrained", "random-encoder", "--out", "--env-steps", "--replay-capacity",
                       "--eval-episodes", "--features", "--logging.tensorboard", "(default: 500000)"]),
    (("downstream", "--algorithm", "skill-ddpg"), ["(default: skill-ddpg)", "--skill-ddpg.n-step", "(default: 2000)"]),
    (("drq",), ["--out", "(default: drq)", "(default: 1000000)", "(default: 0.001)"]),
    (("evaluate",), ["random-policy", "--task", "--episodes", "--csv", "--video", "--colors"]),
    (("probe",), ["random-encoder", "--samples", "--colors", "--csv", "(default: 2000)", "held-out"]),
])  # fmt: skip
def test_help_names_every_argument(call: Call, command: tuple[str, ...], named: list[str]) -> None:
    status, out, err = call(*command, "--help")
    assert (status, err) == (0, "")
    for name in named:
        assert name in out, name


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
    (("pretrain",), r"at least one dataset directory"),
    (("pretrain", "absent"), r"absent"),
    (("finetune", "absent", "absent"), r"absent"),
    (("downstream", "walker_rum", "--pretrained", "random-encoder"), r"'walker_rum'\. Nearest: walker_run"),
    (("downstream", TASK, "--pretrained", "absent"), r"absent does not exist"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--device", "abacus"), r"'abacus' cannot be used"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--discount", "2"), r"discount.*got 2"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--algorithm", "drq", "--intrinsic-reward-coef", "0"),
     r"crptpro drq toy-fixed_go --out"),
    (("drq", "walker_rum"), r"'walker_rum'\. Nearest: walker_run"),
    (("drq", TASK, "--algorithm", "skill-ddpg"), r"learns on a frozen encoder.*--algorithm skill-ddpg"),
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
    (("random-policy", "--task", TASK, "--colors", "reversed_background"), "colors='reversed_image'"),
])  # fmt: skip
def test_an_evaluation_that_cannot_run_says_why(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused(call("evaluate", *arguments, "--csv", "out/returns.csv"))
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
])  # fmt: skip
def test_a_setting_that_pretraining_refuses_is_one_line(
    call: Call, dataset: Path, tmp_path: Path, flag: str, value: str, message: str
) -> None:
    line = refused(call("pretrain", dataset, "--out", tmp_path / "out", flag, value))
    assert re.search(message, line), line
    assert not list((tmp_path / "out").rglob("*.csv"))


@pytest.mark.parametrize("method", ["atc", "apt-c", "proto-rl-c"])
def test_pretrain_trains_any_method_that_random_data_suffice_for(
    call: Call, dataset: Path, tmp_path: Path, method: str
) -> None:
    few = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
    assert call("pretrain", dataset, "--out", tmp_path / "out", "--method", method, *few)[0] == 0
    loaded = load_pretrained(tmp_path / "out" / "encoder")
    assert (loaded.method, loaded.card["training"]["updates"]) == (method, 2)
    assert loaded.projector is not None


def test_pretrain_names_what_a_method_misses_in_random_data(
    call: Call, dataset: Path, tmp_path: Path
) -> None:
    status, _, err = call("pretrain", dataset, "--out", tmp_path, "--method", "becl", "--updates", 1)
    assert status == 1
    assert err.splitlines()[-1].startswith("error: The loss reads 'skill', which the dataset 'toy' lacks")


def test_a_coefficient_of_another_method_is_refused(call: Call, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    line = refused(call("pretrain", dataset, "--out", out, "--method", "atc", "--intr-loss-coef", 0.1))
    assert "'atc' has no option intr_loss_coef" in line
    assert not out.exists()


def test_a_method_registered_elsewhere_trains_with_the_encoder_it_wants(
    call: Call, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    defaults = registry.MethodDefaults(encoder_tau=None, batch_size=4)
    options = {"pixel_offset": 0.5, "channels": (4, 4), "strides": (2, 1)}
    registry.register_method("own", SimCLRLoss, defaults, encoder_options=options)
    own = ("pretrain", dataset, "--out", tmp_path / "out", "--method", "own", "--updates", 2)
    assert call(*own)[0] == 0
    loaded = load_pretrained(tmp_path / "out" / "encoder").require(pixel_offset=0.5)
    assert loaded.card["modules"]["encoder"]["config"]["channels"] == [4, 4]


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
    call: Call, dataset: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    few = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
    pretrain = ("pretrain", dataset, "--out", runs / "pretrain", *few, "--assignment-temperature", 0.05)
    assert call(*pretrain)[0] == 0
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
    for command, record in ((pretrain, "pretrain/pretrain.csv"), (down, "down/eval.csv")):
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
    status, _, err = call(command[0], TASK, *command[1:], "--out", tmp_path / "run", *SMALL)
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

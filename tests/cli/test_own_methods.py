"""Every method from the command line, the user's own included."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command import SIZE, SMALL, TASK, Call, refused, rows

from crptpro.cli.request import explored_domains
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder
from crptpro.objectives import SimCLRLoss, get_method, methods, registry
from crptpro.pretrained import load_pretrained
from crptpro.training import pretrain
from crptpro.training.explore import rewards


@pytest.mark.parametrize(("arguments", "message"), [
    (("pretrain", "walker", "--method", "proto-rl"), r"no method 'proto-rl'\. Did you mean proto-rl"),
    (("pretrain", "walker"), r"walker is no directory.*`crptpro collect walker`"),
    (("pretrain", "data/walker", "--method", "proto-rl-c"), r"proto-rl-c explores.*data/walker is a path\. Name"),
    (("pretrain", ".", "--method", "apt-s"), r"apt-s explores.*\. is a path"),
    (("pretrain", "walkr", "--method", "apt-c"), r"'walkr'\. Nearest: walker"),
    (("pretrain", "--method", "becl"), r"at least one domain, task or group \(A, B, C, D\)"),
    (("pretrain", "A", "--method", "apt-s"), r"one domain, got 3 \(cheetah, walker, quadruped\)"),
    (("pretrain", TASK, "--method", "becl", "--updates", "5"), r"--explore\.env-steps, not --updates"),
    (("pretrain", TASK, "--method", "becl", "--checkpoint-interval", "5"), r"--explore\.checkpoint-interval-env-steps"),
    (("pretrain", TASK, "--method", "becl", "--compile", "on"), r"--compile is for methods that learn from datasets"),
    (("pretrain", TASK, "--method", "apt-c", "--explore.env-steps", "10"), r"10 env steps.*no update of encoder"),
    (("pretrain", TASK, "--method", "apt-c", "--explore.reward", "wealth"), r"no intrinsic reward 'wealth'; known: "),
    (("pretrain", TASK, "--method", "apt-c", "--explore.reward", "prototype"), r"SimCLRLoss has no prototypes"),
    (("pretrain", TASK, "--method", "apt-c", "--explore.agent", "me"), r"no exploring agent 'me'; known: "),
    (("pretrain", TASK, "--method", "proto-rl-c", "--explore.queue-size", "7"), r"queue_size must be a multiple"),
    (("--plugin", "absent.py", "pretrain", TASK), r"--plugin absent\.py: there is no such file"),
    (("pretrain", TASK, "--plugin=absent_module"), r"--plugin absent_module: there is no such module"),
])  # fmt: skip
def test_a_request_that_cannot_be_met_leaves_nothing_behind(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    line = refused(call(*arguments, "--out", tmp_path / "out"))
    assert re.search(message, line), line
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_called_like_a_domain_is_not_in_its_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walker").mkdir()
    (tmp_path / "mine").mkdir()
    assert explored_domains(["walker"], "apt-s") == ["walker"]
    with pytest.raises(CRPTproError, match="mine is a path"):
        explored_domains(["mine"], "apt-s")


def test_pretrain_trains_other_methods_on_datasets(call: Call, dataset: Path, tmp_path: Path) -> None:
    few = ("--updates", 2, "--batch-size", 4, "--log-interval", 1)
    assert call("pretrain", dataset, "--out", tmp_path / "out", "--method", "atc", *few)[0] == 0
    loaded = load_pretrained(tmp_path / "out" / "encoder")
    assert (loaded.method, loaded.card["training"]["updates"]) == ("atc", 2)
    assert loaded.projector is not None


def test_a_method_that_learns_from_datasets_does_not_explore(
    call: Call, dataset: Path, tmp_path: Path
) -> None:
    line = refused(call("pretrain", dataset, "--out", tmp_path / "out", "--explore.env-steps", 10))
    assert "crptpro learns from datasets and does not explore" in line
    assert not (tmp_path / "out").exists()


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


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file with methods of its own; what it registers is forgotten afterwards."""
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    monkeypatch.setattr(rewards, "_BUILDERS", dict(rewards._BUILDERS))
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry) != Path(__file__).parent])
    yield Path(__file__).with_name("own_method.py")
    sys.modules.pop("own_method", None)


def test_a_registration_in_a_file_of_the_users_makes_a_method(
    call: Call, dataset: Path, tmp_path: Path, plugin: Path
) -> None:
    assert "slowness" not in methods()
    out = tmp_path / "out"
    own = ("pretrain", dataset, "--out", out, "--method", "slowness", "--log-interval", 1, "--plugin", plugin)
    assert call(*own)[0] == 0
    assert {"slowness", "slowness-active"} <= set(methods())  # what lists methods lists it
    loaded = load_pretrained(out / "encoder")
    assert (loaded.method, loaded.card["training"]["updates"]) == ("slowness", 2)
    assert float(rows(out / "pretrain.csv")[-1]["loss_slow"]) > 0

    again = (out / "encoder", dataset, "--out", tmp_path / "fine", "--updates", 1, "--batch-size", 4)
    assert call("finetune", *again, "--plugin", plugin)[0] == 0
    assert load_pretrained(tmp_path / "fine" / "encoder").label == "slowness-finetune"

    # In Python it is one line.
    loss = get_method("slowness").build(PixelEncoder(image_size=SIZE))
    assert pretrain(loss, dataset, progress=False).updates == 2


def test_a_method_of_the_users_explores_for_a_reward_of_its_own(
    call: Call, tmp_path: Path, plugin: Path
) -> None:
    out = tmp_path / "out"
    own = ("--plugin", plugin, "pretrain", TASK, "--out", out, "--method", "slowness-active")
    few = ("--log-interval", 1, "--explore.hidden-dim", 8, "--explore.replay-capacity", 40)
    status, _, err = call(*own, *few)
    assert status == 0, err
    assert "60 env steps over toy-fixed" in err
    assert "reward activity, explorer rad-sac" in err
    loaded = load_pretrained(out / "encoder")
    assert (loaded.method, loaded.card["loss"]["config"]["margin"]) == ("slowness-active", 0.5)
    explored = rows(out / "explore.csv")
    assert all(float(row["intrinsic_reward/toy-fixed"]) > 0 for row in explored)

    down = ("downstream", TASK, "--pretrained", out / "encoder", "--out", tmp_path / "down", *SMALL)
    assert call(*down)[0] == 0
    assert {row["method"] for row in rows(tmp_path / "down" / "eval.csv")} == {"slowness-active"}

    before = (out / "pretrain.csv").read_bytes()
    status, _, err = call(*own, *few)
    assert status == 0
    assert "active pre-training: already at 60 env steps" in err
    assert (out / "pretrain.csv").read_bytes() == before


def test_a_plugin_that_cannot_be_imported_says_so(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "needs_more.py").write_text("import a_package_that_nobody_has")
    (tmp_path / "json.py").write_text("")
    assert "it cannot be imported" in refused(call("--plugin", tmp_path / "needs_more.py", "doctor"))
    assert "'json' is the name of another module" in refused(call("--plugin", tmp_path / "json.py", "doctor"))
    assert "needs a module or a Python file" in refused(call("doctor", "--plugin"))


def test_a_batch_too_small_for_the_prototype_reward_is_announced(
    call: Call, tmp_path: Path, plugin: Path
) -> None:
    few = (
        "--explore.env-steps",
        24,
        "--explore.random-agent-steps",
        8,
        "--explore.hidden-dim",
        8,
        "--batch-size",
        4,
    )
    status, _, err = call("pretrain", TASK, "--out", tmp_path / "out", "--method", "proto-rl-c", *few)
    assert status == 0, err
    assert "512 prototypes draw their candidates from batches of 4" in err

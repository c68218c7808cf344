"""Every method from the command line, the user's own included."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command import SIZE, SMALL, TASK, Call, refused, rows

import crptpro.objectives.methods as registry
from crptpro.modules import PixelEncoder
from crptpro.objectives import get_method, method_names
from crptpro.pretrained import load_pretrained
from crptpro.training import pretrain


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file with methods of its own; what it registers is forgotten afterwards."""
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry) != Path(__file__).parent])
    yield Path(__file__).with_name("own_method.py")
    sys.modules.pop("own_method", None)


def test_a_registration_in_a_file_of_the_users_makes_a_method(
    call: Call, dataset: Path, tmp_path: Path, plugin: Path
) -> None:
    assert "slowness" not in method_names()
    out = tmp_path / "out"
    own = ("pretrain", dataset, "--out", out, "--method", "slowness", "--log-interval", 1, "--plugin", plugin)
    assert call(*own)[0] == 0
    assert {"slowness", "slowness-active"} <= set(method_names())  # what lists methods lists it
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
    few = ("--log-interval", 1, "--hidden-dim", 8, "--replay-capacity", 40)
    status, _, err = call(*own, *few)
    assert status == 0, err
    loaded = load_pretrained(out / "encoder")
    assert (loaded.method, loaded.card["loss"]["config"]["margin"]) == ("slowness-active", 0.5)
    explored = rows(out / "explore.csv")
    rewards = [
        float(row["intrinsic_reward/toy-fixed"]) for row in explored if row["intrinsic_reward/toy-fixed"]
    ]
    assert len(rewards) >= len(explored) - 1  # the first row may come before the agent's first update
    assert min(rewards) > 0

    down = ("downstream", TASK, "--pretrained", out / "encoder", "--out", tmp_path / "down", *SMALL)
    assert call(*down)[0] == 0
    assert {row["method"] for row in rows(tmp_path / "down" / "eval.csv")} == {"slowness-active"}

    before = (out / "pretrain.csv").read_bytes()
    status, _, err = call(*own, *few)
    assert status == 0
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

"""Every recipe and every method from nothing to an evaluation on the real simulator: half, then the same call again."""

from __future__ import annotations

import hashlib
import json
import re
import runpy
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from toy_env import record

from crptpro.data import collect_group
from crptpro.domains import GROUPS
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder
from crptpro.objectives import Method, ProtoLoss, get_method, method_names
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import DownstreamConfig, ExploreConfig, PretrainConfig, load_agent

RECIPES = Path(__file__).parents[2] / "recipes"
TASK = "gymnasium:Reacher-v5"
"""Real MuJoCo pixels with episodes of 25 decisions."""
EPISODE = 50

CONTROLS = ["random-encoder", "random-encoder-standardised"]


def way(method: Method) -> tuple[str, dict[str, Any]]:
    """The recipe of a method, and its settings."""
    if method.exploration is not None:
        several = (TASK,) if method.name != "proto-rl-c" else (TASK, "cartpole")
        return "explore", {"method": method.name, "domains": several, "tasks": (TASK,)}
    if method.name == "drq":
        return "drq", {"tasks": (TASK,)}
    return "paper", {"group": "D", "method": method.name, "tasks": (TASK,)}


ROWS = [get_method(name) for name in method_names(presets=True)]
WAYS = {row.name: way(row) for row in ROWS if not row.is_preset} | {"crptpro-finetune": ("finetune", {"domain": TASK})}
RESUMED: dict[str, dict[str, Any]] = {
    **dict(WAYS[method] for method in ("crptpro", "crptpro-finetune", "proto-rl-c", "drq")),
    "quickstart": {"task": TASK, "domains": GROUPS["D"], "action_repeat": 2},
    "own_domain": {"task": TASK},
}


@pytest.fixture(autouse=True)
def _own_domain_is_imported_anew() -> Iterator[None]:
    """What it registers is forgotten after each test."""
    yield
    sys.modules.pop("recipes.own_domain", None)


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., None]:
    """Run a recipe on random data of group D, or on an encoder to fine-tune, that are made once."""
    made = tmp_path_factory.mktemp("made")
    collect_group(GROUPS["D"], made / "data", transitions=12, seed=0, workers=1, quality="fast", progress=False)
    torch.manual_seed(0)
    save_pretrained(ProtoLoss(PixelEncoder(), num_prototypes=16, latent_dim=8, hidden_dim=16), made / "source")

    def run(name: str, out: Path, half: int, learned: int, **settings: Any) -> None:
        """So many halves of the budgets: of pre-training, and of learning."""
        recipe = import_module(f"recipes.{name}")
        small = {"batch_size": 4, "precision": "fp32"}
        acting = {**small, "random_agent_steps": 8, "hidden_dim": 16, "queue_size": 1024}
        usual = {
            "transitions": 12, "workers": 1, "quality": "fast", "pretrained": str(made / "source"),
            "pretrain": PretrainConfig(updates=2 * half, log_interval=1, **small),
            "explore": ExploreConfig(
                env_steps=32 * len(settings.get("domains", (TASK,))), log_interval=4,
                checkpoint_interval_env_steps=100, **acting,
            ),
            "downstream": DownstreamConfig(
                env_steps=learned * EPISODE, replay_capacity=60, eval_interval_env_steps=EPISODE, eval_episodes=1,
                eval_workers=0, checkpoint_interval_env_steps=EPISODE, log_interval_env_steps=20, **acting
            ),
        }  # fmt: skip
        names = {field.name for field in fields(recipe.Config)}
        if name in ("paper", "quickstart") and not out.exists():
            shutil.copytree(made / "data", out / "data")
        recipe.main(recipe.Config(out=out, **{k: v for k, v in usual.items() if k in names}, **settings))

    return run


def left(out: Path) -> dict[str, object]:
    """Return every record, and a digest of every file of weights, below a directory."""
    found: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        if path.suffix == ".csv" and "report" not in path.parts:
            found[str(path.relative_to(out))] = record(path)
        elif path.suffix == ".safetensors" and "checkpoints" not in path.parts:
            found[str(path.relative_to(out))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


@pytest.mark.gl
@pytest.mark.parametrize("method", WAYS)
def test_every_method_ends_in_evaluations(method: str, tmp_path: Path, run: Callable[..., None]) -> None:
    out, (recipe, settings) = tmp_path / "out", WAYS[method]
    run(recipe, out, 1, 1, **settings)
    (evaluation,) = out.rglob("eval.csv")
    assert [row["env_steps"] for row in record(evaluation)] == ["0", str(EPISODE)]
    assert {row["method"] for row in record(evaluation)} == {method}
    _, card = load_agent(evaluation.parent / "agent")
    assert card["task"] == TASK
    encoders = list(out.rglob("encoder"))
    assert len(encoders) == (recipe in ("paper", "explore", "finetune") and method not in CONTROLS)
    for path in encoders:
        pretrained = load_pretrained(path)
        assert pretrained.label == method
        assert card["pretrained"] == pretrained.identity()
    has_bonus = method.startswith(("crptpro", "proto-rl"))
    assert {"intrinsic_reward" in row for row in record(evaluation.parent / "train.csv")} == {has_bonus}


@pytest.mark.gl
@pytest.mark.parametrize("recipe", RESUMED)
def test_twice_the_budget_is_the_budget_and_the_same_call_again(
    recipe: str, tmp_path: Path, run: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, parts, settings = tmp_path / "whole", tmp_path / "parts", RESUMED[recipe]
    with monkeypatch.context() as patch:
        patch.setattr("recipes.quickstart.build_report", lambda out: out)
        run(recipe, whole, 2, 2, **settings)
        with monkeypatch.context() as stopping:
            stopping.setattr(f"recipes.{recipe}.train_downstream", Mock(side_effect=KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                run(recipe, parts, 1, 1, **settings)
        if recipe != "quickstart":  # whose learning is that of the others
            run(recipe, parts, 2, 1, **settings)
    run(recipe, parts, 2, 2, **settings)
    expected, found = left(whole), left(parts)
    assert expected.keys() == found.keys()
    assert [name for name in expected if expected[name] != found[name]] == []
    if recipe == "quickstart":
        figures = list((parts / "report" / "figures").glob("*.png"))
        page = (parts / "report" / "report.md").read_text()
        assert figures
        assert all(figure.name in page for figure in figures)
        assert "random-encoder" in page
        scores = json.loads((parts / "scores.json").read_text())
        assert [*scores] == ["crptpro", "random-encoder", "uniform random policy"]


@pytest.mark.gl
def test_the_method_is_written_with_torchrls_idioms_in_sixty_lines() -> None:
    text = (RECIPES / "plain_torchrl.py").read_text()
    assert len(text.splitlines()) <= 60
    main = import_module("recipes.plain_torchrl").main  # with its own task: dm_control cannot be used once closed
    sac = main(transitions=100, updates=2, batch_size=8, agent_steps=12)
    assert any(parameter.grad is not None and parameter.grad.any() for parameter in sac.actor.parameters())


@pytest.mark.gl
def test_the_pieces_of_the_quickstart_run_in_the_cells_of_a_notebook(tmp_path: Path) -> None:
    imports, _ = (RECIPES / "quickstart.py").read_text().split("\nlogger = ")
    pieces = f"""
        out = Path({str(tmp_path)!r})
        datasets = collect_group([{TASK!r}], out / "data", transitions=12, workers=2)
        loss = ProtoLoss(PixelEncoder(channels=(4,), strides=(2,)), num_prototypes=16)
        result = pretrain(loss, datasets, run_dir=out / "pretrain", updates=2, batch_size=4)
        encoder = save_pretrained(result, out / "encoder")
        run = train_downstream({TASK!r}, encoder, run_dir=out / "crptpro", env_steps=50, batch_size=4,
                               replay_capacity=60, random_agent_steps=12, hidden_dim=16, eval_interval_env_steps=50,
                               eval_episodes=2, eval_workers=1)
        print(len(run.evaluations), "episodes evaluated")
    """
    own_environment = f"""
        from crptpro.domains import Domain
        def make(*, seed, image_size):
            return make_env({TASK!r}, seed=seed, image_size=image_size, frame_stack=1)
        collect_group([Domain("mine", "mine_go", make=make)], out / "data", transitions=12, workers=2)
    """
    # As a notebook's kernel does: cells in `__main__`, which no file holds, inside a running event loop.
    kernel = """
        import asyncio, sys
        async def run_cells():
            for number, cell in enumerate(sys.argv[1:], 1):
                exec(compile(cell, f"<cell {number}>", "exec"), vars(sys.modules["__main__"]))
        asyncio.run(run_cells())
    """
    cells = [imports, *map(textwrap.dedent, (pieces, own_environment))]
    command = [sys.executable, "-c", textwrap.dedent(kernel), *cells]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    # Only an environment whose factory a cell defines is out of the worker processes' reach.
    assert re.findall("(.*) is collected in this process", ended.stderr) == ["mine"]
    assert ended.stdout.endswith("4 episodes evaluated\n")


@pytest.mark.parametrize("recipe", ["drq", "explore", "finetune", "own_domain", "paper", "quickstart"])
def test_a_stage_has_no_option_that_the_recipe_sets(
    recipe: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(*arguments: str) -> tuple[Any, str]:
        monkeypatch.setattr(sys, "argv", [recipe, *arguments])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(RECIPES / f"{recipe}.py"), run_name="__main__")
        return ended.value.code, "".join(capsys.readouterr())

    status, told = ends("--help")
    options = set(re.findall(r"--([\w.-]+)", told))
    stages = [name.split(".") for name in options if "." in name]
    assert status == 0
    assert {"seed", "downstream.batch-size", "downstream.device"} <= options
    assert [option for _, option in stages if option in options] == []
    assert ends("--downstream.seed", "1")[0] == 2


@pytest.mark.parametrize(
    ("recipe", "changes", "message"),
    [
        ("paper", {"tasks": ("walkr_run",)}, "Nearest: walker"),
        ("finetune", {"pretrained": "group-a", "domain": "walker"}, "slim"),
        ("finetune", {"pretrained": "absent", "domain": "walker"}, "absent does not exist"),
        ("finetune", {"pretrained": "absent", "domain": "walkr"}, "Nearest: walker"),
        ("quickstart", {"task": "walkr"}, "Nearest: walker"),
        ("drq", {"tasks": ("walkr",)}, "Nearest: walker"),
    ],
)
def test_what_a_recipe_cannot_do_ends_it_before_it_collects(
    recipe: str, changes: dict[str, object], message: str, tmp_path: Path
) -> None:
    module = import_module(f"recipes.{recipe}")
    with pytest.raises((CRPTproError, ValueError), match=message):
        module.main(module.Config(out=tmp_path / "out", **changes))
    assert not (tmp_path / "out").exists()

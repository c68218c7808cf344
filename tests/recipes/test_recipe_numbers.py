"""A recipe spells the numbers of its method out; they are the ones that the library has."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType

import pytest
from recipe_process import RECIPES

from crptpro.errors import CRPTproError
from crptpro.objectives import get_method
from crptpro.training import ActiveConfig, SACSettings, drq_settings
from crptpro.training.explore.plan import make_plan, resolve


def load(recipe: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"{recipe}_recipe", RECIPES / f"{recipe}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their annotations up
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.modules[spec.name]
    return module


def loss_options(config: object, method: str) -> dict[str, object]:
    """Options of the method's loss that the recipe names, with the recipe's values."""
    names = inspect.signature(get_method(method).loss_class.__init__).parameters
    return {name: value for name, value in vars(config).items() if name in names}


@pytest.mark.parametrize(
    ("recipe", "method", "bonus", "replay_capacity"),
    [
        ("crptpro", "crptpro", 0.2, 40_000),
        ("atc", "atc", 0.0, 40_000),
        ("apt", "apt-c", 0.0, 40_000),
        ("apt", "apt-s", 0.0, 40_000),
        ("proto_rl", "proto-rl-c", 0.2, 100_000),
        ("proto_rl", "proto-rl-s", 0.2, 100_000),
        ("becl", "becl", 0.0, 40_000),
    ],
)
def test_a_recipe_has_the_numbers_of_its_method(
    recipe: str, method: str, bonus: float, replay_capacity: int
) -> None:
    config, known = load(recipe).Config(), get_method(method)
    assert config.pretrain_batch_size == known.defaults.batch_size
    assert config.pretrain_learning_rate == known.defaults.lr
    parameters = inspect.signature(known.loss_class.__init__).parameters
    defaults = {**{name: parameter.default for name, parameter in parameters.items()}, **known.loss_options}
    options = loss_options(config, method)
    assert len(options) >= 2
    assert options == {name: defaults[name] for name in options}
    if known.exploration is None:
        assert config.updates == known.defaults.updates
        assert config.encoder_tau == known.defaults.encoder_tau
    else:
        asked = resolve(ActiveConfig(**vars(config.explore)), known.exploration, known.defaults)
        neighbours = {"prototype": 3, "particle": 12}.get(known.exploration.reward)
        assert asked == resolve(ActiveConfig(knn_k=neighbours), known.exploration, known.defaults)
    assert config.downstream == SACSettings(intrinsic_reward_coef=bonus, replay_capacity=replay_capacity)
    assert config.downstream.env_steps == 500_000


def test_drq_has_the_numbers_of_the_library() -> None:
    recipe = load("drq")
    assert drq_settings(**vars(recipe.DrQ())) == drq_settings()
    assert set(vars(recipe.DrQ())) <= {field.name for field in dataclasses.fields(drq_settings())}
    assert len(recipe.Config().tasks) == 8


@pytest.mark.parametrize(
    ("recipe", "method", "domains", "settings"),
    [
        ("apt", "apt-c", 3, {}),
        ("apt", "apt-s", 1, {}),
        ("proto_rl", "proto-rl-c", 3, {}),
        ("proto_rl", "proto-rl-s", 1, {}),
        ("becl", "becl", 3, {}),
        ("becl", "becl", 3, {"encoder_updates_each": 1}),
        ("becl", "apt-c", 3, {}),
    ],
)
def test_a_recipe_names_as_many_encoder_updates_as_there_will_be(
    recipe: str, method: str, domains: int, settings: dict[str, int]
) -> None:
    known = get_method(method)
    plan = make_plan(resolve(ActiveConfig(**settings), known.exploration, known.defaults), [2] * domains)
    assert f"{plan.encoder_updates:,}" in (RECIPES / f"{recipe}.py").read_text()


@pytest.mark.parametrize(
    ("recipe", "changes", "message"),
    [
        ("crptpro", {"device": "abacus"}, "'abacus' cannot be used"),
        ("atc", {"device": "abacus"}, "'abacus' cannot be used"),
        ("finetune", {"pretrained": Path("absent")}, "absent does not exist"),
        ("finetune", {"pretrained": Path("absent"), "device": "abacus"}, "'abacus' cannot be used"),
        ("finetune", {"pretrained": Path("absent"), "domain": "walkr"}, "Nearest: walker"),
        ("quickstart", {"task": "walkr"}, "Nearest: walker"),
        ("quickstart", {"env_steps": 0}, "env_steps"),
    ],
)
def test_what_a_later_stage_would_refuse_ends_a_recipe_before_it_collects(
    recipe: str, changes: dict[str, object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = load(recipe)
    for collect in ("collect_group", "collect_random"):
        monkeypatch.setattr(module, collect, lambda *_, **__: pytest.fail("it collects"), raising=False)
    with pytest.raises((CRPTproError, ValueError), match=message):
        module.main(module.Config(out=tmp_path, **changes))

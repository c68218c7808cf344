"""The layers of the package: a module imports from its own layer and from lower ones."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import crptpro

PACKAGE = Path(crptpro.__file__).parent
FOUNDATION = [
    "errors", "values", "seeding", "provenance", "artifact", "directory_lock", "console", "logging",
    "plugins", "workers", "progress", "free_memory",
]  # fmt: skip
ORDER = [
    "domains", "transforms.base", "transforms.color_swap", "envs", "data", "modules", "objectives", "transforms",
    "pretrained", "training", "analysis", "experiments", "doctor", "cli",
]  # fmt: skip
RANKS = dict.fromkeys(FOUNDATION, 0) | {part: rank for rank, part in enumerate(ORDER, start=1)}
FILES = sorted(PACKAGE.rglob("*.py"))


def rank_of(module: str) -> int:
    candidates = [part for part in RANKS if module == part or module.startswith(f"{part}.")]
    assert candidates, f"{module} belongs to no layer; name one in {Path(__file__).name}"
    return RANKS[max(candidates, key=len)]


def imports_of(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_to_the_same_layer_or_a_lower_one(path: Path) -> None:
    module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").strip(".")
    if module in ("", "cli", "__main__"):
        return
    for name in imports_of(path):
        if name.startswith("crptpro."):
            assert rank_of(name.removeprefix("crptpro.")) <= rank_of(module), f"{module} imports {name}, a higher layer"


@pytest.mark.parametrize("part", ["modules", "objectives", "transforms"])
def test_the_mathematics_knows_nothing_of_simulators_loggers_or_files(part: str) -> None:
    foreign = {"dm_control", "mujoco", "gymnasium", "wandb", "matplotlib"}
    for path in (PACKAGE / part).rglob("*.py"):
        assert not {name.split(".")[0] for name in imports_of(path)} & foreign, path

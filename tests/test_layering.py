"""The order in which data walks the house: an import may only point towards the entrance."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import crptpro

PACKAGE = Path(crptpro.__file__).parent
FOUNDATION = [
    "errors", "values", "seeding", "provenance", "artifact", "directory_lock", "console", "logging",
    "plugins", "workers", "progress",
]  # fmt: skip
ORDER = [
    "domains", "transforms.base", "transforms.color_swap", "envs", "data", "modules", "objectives", "transforms",
    "pretrained", "training", "analysis", "experiments", "doctor", "cli",
]  # fmt: skip
FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(module: str) -> str:
    """The entry of ORDER or FOUNDATION that a dotted module belongs to, the most specific one."""
    candidates = [p for p in [*FOUNDATION, *ORDER] if module == p or module.startswith(f"{p}.")]
    assert candidates, f"{module} has no place in the house; give it one in {Path(__file__).name}"
    return max(candidates, key=len)


def imports_of(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_to_an_earlier_part(path: Path) -> None:
    module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").strip(".")
    if module in ("", "cli", "__main__"):
        return
    own = part_of(module)
    for name in imports_of(path):
        if not name.startswith("crptpro."):
            continue
        imported = part_of(name.removeprefix("crptpro."))
        if own in FOUNDATION:
            assert imported in FOUNDATION, f"{module} is foundation and imports {name}"
        elif imported in ORDER:
            assert ORDER.index(imported) <= ORDER.index(own), f"{module} imports {name}, a later part"


@pytest.mark.parametrize("part", ["modules", "objectives", "transforms"])
def test_the_mathematics_knows_nothing_of_simulators_loggers_or_files(part: str) -> None:
    foreign = {"dm_control", "mujoco", "gymnasium", "wandb", "matplotlib"}
    for path in (PACKAGE / part).rglob("*.py"):
        assert not {name.split(".")[0] for name in imports_of(path)} & foreign, path

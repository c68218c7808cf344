from __future__ import annotations

import os
from pathlib import Path

import pytest

import crptpro
from crptpro.experiments.store import Store

collect_ignore = ["fake_experiment.py", "conftest.py"]
"""A plugin changes the catalogue of whoever imports it, be it only to look for doctests."""


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "root")


@pytest.fixture
def source_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs find the package where this process found it."""
    source = str(Path(crptpro.__file__).parents[1])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([source, os.environ.get("PYTHONPATH", "")]))

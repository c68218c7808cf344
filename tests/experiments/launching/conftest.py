from __future__ import annotations

from pathlib import Path

import pytest

from crptpro.experiments.building import Store

collect_ignore = ["fake_experiment.py", "conftest.py"]
"""A plugin changes the catalogue of whoever imports it, be it only to look for doctests."""


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "root")

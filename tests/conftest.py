"""Tests marked `gpu` are left out without a CUDA device; `--precision` decides what `auto` means on a CPU."""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest
import torch

from crptpro.modules import precision

# Looking for doctests would import this file once more, under a name that another conftest.py has too.
collect_ignore = ["conftest.py"]


@pytest.fixture(autouse=True)
def _log_is_as_a_library_has_it() -> None:
    """A command that an earlier test ran in this process has given the log a handler of its own."""
    library = logging.getLogger("crptpro")
    library.handlers.clear()
    library.setLevel(logging.NOTSET)
    library.propagate = True


@pytest.fixture
def plugins_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a plugin registers is as it was afterwards."""
    import gymnasium

    from crptpro import plugins
    from crptpro.experiments import matrix
    from crptpro.objectives import methods

    monkeypatch.setattr(plugins, "_loaded", [])  # processes of later tests would load what this one has loaded
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry) != Path(__file__).parent / "cli"])
    with patch.dict(matrix.EXPERIMENTS), patch.dict(methods._METHODS), patch.dict(gymnasium.registry):
        yield
    for name in ("own_method", "slow_env"):
        sys.modules.pop(name, None)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--precision", choices=("fp32", "bf16"), help="what `auto` means in the test process, on a CPU")


def pytest_configure(config: pytest.Config) -> None:
    if (forced := config.getoption("--precision")) is not None:
        precision.CPUINFO = Path(tempfile.mkdtemp()) / "cpuinfo"
        precision.CPUINFO.write_text("flags: amx_bf16" if forced == "bf16" else "flags:")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    left_out = [item for item in items if item.get_closest_marker("gpu")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("gpu")]

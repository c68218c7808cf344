"""What every test begins with; `--precision` decides what `auto` means on a CPU."""

from __future__ import annotations

import logging
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest

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


@pytest.fixture(autouse=True)
def _signals_are_as_in_the_foreground() -> Iterator[None]:
    """Under nohup, and in the background, some are ignored."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


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

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

from crptpro import domains, plugins
from crptpro.modules import precision
from crptpro.objectives import methods

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


@pytest.fixture(autouse=True)
def _registries_are_as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers, and the plugins it loads, are forgotten."""
    monkeypatch.setattr(plugins, "_loaded", [*plugins._loaded])  # processes of later tests would load these
    with patch.dict(methods._METHODS), patch.dict(domains._registered):
        yield


@pytest.fixture
def plugins_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Plugins are imported anew by the next test; experiments and environments that they register are forgotten."""
    import gymnasium

    from crptpro.experiments import matrix

    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry) != Path(__file__).parent / "cli"])
    with patch.dict(matrix.EXPERIMENTS), patch.dict(gymnasium.registry):
        yield
    for name in ("own_method", "slow_env"):
        sys.modules.pop(name, None)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--precision", choices=("fp32", "bf16"), help="what `auto` means in the test process, on a CPU")


def pytest_configure(config: pytest.Config) -> None:
    if (forced := config.getoption("--precision")) is not None:
        precision.CPUINFO = Path(tempfile.mkdtemp()) / "cpuinfo"
        precision.CPUINFO.write_text("flags: amx_bf16" if forced == "bf16" else "flags:")

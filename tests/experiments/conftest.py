"""What several tests of reports read: one report on everything, made once."""

from __future__ import annotations

from pathlib import Path

import pytest
from whole_reproduction import make_whole

from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.report import build_report

# Looking for doctests would import this file once more, under a name that another conftest.py has too.
collect_ignore = ["conftest.py"]


@pytest.fixture(scope="session")
def whole_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a root with every experiment."""
    return build_report(make_whole(tmp_path_factory.mktemp("whole")).root, bootstrap=Bootstrap(replicates=50))

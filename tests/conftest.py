"""Tests marked `gpu` are left out where there is no CUDA device."""

from __future__ import annotations

import pytest
import torch

# Looking for doctests would import this file once more, under a name that another conftest.py has too.
collect_ignore = ["conftest.py"]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    left_out = [item for item in items if item.get_closest_marker("gpu")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("gpu")]

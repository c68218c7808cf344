"""The README and the page of results say what the committed records say."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

RESULTS = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "results.py"))


@pytest.mark.parametrize("page", RESULTS["PAGES"], ids=lambda page: page.name)
def test_every_table_is_the_one_that_the_records_give(page: Path) -> None:
    text = page.read_text()
    assert "<!-- table: " in text
    assert RESULTS["filled"](text) == text, "run `python docs/results.py`"

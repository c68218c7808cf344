"""The README and the page of results say what the committed records say."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

RESULTS = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "results.py"))


@pytest.mark.parametrize("page", RESULTS["PAGES"], ids=lambda page: page.name)
def test_every_table_is_the_one_that_the_records_give(page: Path) -> None:
    text = page.read_text()
    assert "<!-- table: " in text
    assert RESULTS["filled"](text) == text, "run `python docs/results.py`"


def test_the_readme_quotes_the_returns_of_the_quickstart() -> None:
    readme = " ".join(RESULTS["PAGES"][0].read_text().split())
    ours = r"returned (\d+) on the pre-trained encoder, (\d+) on the untrained one, and (\d+) with random actions"
    quoted = re.search(ours, readme)
    assert quoted is not None
    assert list(quoted.groups()) == [cell.split()[0] for cell in RESULTS["quickstart"]().iloc[-1, -3:]]

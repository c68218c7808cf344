from __future__ import annotations

from pathlib import Path

import pytest

from crptpro.experiments import markdown
from crptpro.experiments.markdown import markdown_table, write_report


def read_table(text: str) -> list[dict[str, str]]:
    """The rows of the one Markdown table in a text."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert set(cells[1]) == {"---"}
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


def test_a_table_reads_back_with_its_columns_in_order() -> None:
    rows = [
        {"policy": "trained", "mean": 12.5, "episodes": 3},
        {"policy": "chance", "mean": 1, "episodes": 3},
    ]
    table = markdown_table(rows)
    assert read_table(table) == [{key: str(value) for key, value in row.items()} for row in rows]
    assert table.splitlines()[0] == "| policy | mean | episodes |"


def test_a_missing_cell_stays_empty() -> None:
    assert read_table(markdown_table([{"a": 1, "b": 2}, {"a": 3}])) == [
        {"a": "1", "b": "2"},
        {"a": "3", "b": ""},
    ]


def report(path: Path, **changes: object) -> Path:
    content = {
        "title": "A run",
        "command": "python recipe.py --seed 1",
        "summary": "It learned.",
        "tables": {"Returns": [{"policy": "trained", "mean": "3.0"}]},
        "figures": {"Curve": path.parent / "figures" / "curve.png"},
        "caveats": ["One seed."],
    }
    return write_report(path, **{**content, **changes})


def test_a_report_says_what_was_run_what_came_out_and_on_what(tmp_path: Path) -> None:
    path = report(tmp_path / "report.md")
    text = path.read_text()
    for part in (
        "# A run", "It learned.", "Made by `python recipe.py --seed 1`.", "## Returns", "![Curve](figures/curve.png)",
        "## What this does not show", "- One seed.", "GiB RAM", "torch ",
    ):  # fmt: skip
        assert part in text, part
    assert read_table(text) == [{"policy": "trained", "mean": "3.0"}]
    assert [file.name for file in tmp_path.iterdir()] == ["report.md"]
    assert "does not show" not in report(path, caveats=[]).read_text()


def test_a_report_that_cannot_be_finished_leaves_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = report(tmp_path / "report.md")
    before = path.read_text()

    def fail() -> dict[str, str]:
        raise OSError("disk full")

    monkeypatch.setattr(markdown, "versions", fail)
    with pytest.raises(OSError, match="disk full"):
        report(path, summary="Something else.")
    assert path.read_text() == before

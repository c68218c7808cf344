"""Cost of pre-training in a report: timings that were made on several machines say so wherever they stand together."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_reproduction import Reproduction, write_table
from report_reading import blocks_of, cell, page_of, table_in, words

from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.goals import Request
from crptpro.experiments.measurements import TimingPiece
from crptpro.experiments.report.blocks import Block, Figure
from crptpro.experiments.scales import SMALL
from crptpro.experiments.store import DONE

BY_DOMAINS = "by number of domains"
ONE, OTHER = "A CPU, 2 cores, 24 GiB, no GPU", "Another CPU, 2 cores, 24 GiB, no GPU"


@pytest.fixture
def timings(tmp_path: Path) -> dict[tuple[str, int], TimingPiece]:
    """Timings of two methods, every part of apt-s's sums among the pieces."""
    made = Reproduction(tmp_path)
    goals = EXPERIMENTS["efficiency"].goals(Request(SMALL, groups=("A",), methods=("crptpro", "apt-s")))
    made.ask("efficiency", goals)
    found = {}
    for goal in goals:
        assert isinstance(goal.piece, TimingPiece)
        domains = int(dict(goal.place)["domains"])
        found[goal.label, domains] = goal.piece
        sums = goal.piece.parts if domains > 1 and goal.label == "apt-s" else ()
        for piece, count in ((goal.piece, domains), *((part, 1) for part in sums)):
            row = {
                "method": goal.label, "domains": count, "seconds_per_update": 0.5, "paper_projected_hours": count,
                "paper_updates": 50_000, "device": "cpu", "threads": 2,
            }  # fmt: skip
            write_table(made.finish(piece) / "timing.csv", [row])
    return found


def move(root: Path, piece: TimingPiece) -> None:
    """Let a piece be made on the other machine."""
    path = root / "pieces" / piece.key / DONE
    done = json.loads(path.read_text())
    path.write_text(json.dumps({**done, "hardware": {**done["hardware"], "cpu": "Another CPU"}}))


def section(root: Path) -> tuple[Block, ...]:
    return blocks_of(page_of(root), "efficiency-small")


def bars_of(blocks: tuple[Block, ...]) -> tuple[list[str], str]:
    (hours,) = (block for block in blocks if isinstance(block, Figure) and block.name.endswith("-hours"))
    return [label.get_text() for label in hours.drawing.axes[0].get_yticklabels()], hours.caption


def test_timings_of_one_machine_compare_and_need_no_numbers(
    timings: dict[tuple[str, int], TimingPiece], tmp_path: Path
) -> None:
    found = section(tmp_path)
    assert "made on" not in table_in(found, BY_DOMAINS).columns
    names, caption = bars_of(found)
    assert names == ["crptpro", "apt-s"]
    assert "machine" not in caption
    assert "(hardware below)" in words(found)


def test_timings_of_several_machines_are_numbered_in_the_table_and_in_the_bars(
    timings: dict[tuple[str, int], TimingPiece], tmp_path: Path
) -> None:
    move(tmp_path, timings["crptpro", 3])
    found = section(tmp_path)
    table = table_in(found, BY_DOMAINS)
    numbers = [
        cell(table, "made on", method, count).text for method in ("crptpro", "apt-s") for count in "123"
    ]
    assert numbers == ["1", "1", "2", "1", "1", "1"]
    names, caption = bars_of(found)
    assert names == ["crptpro [2]", "apt-s [1]"]
    assert "hours compare only within one" in caption
    assert f"Made on 1: {ONE}; 2: {OTHER}. Times compare only within one machine" in words(found)


def test_a_sum_was_made_where_its_parts_were(
    timings: dict[tuple[str, int], TimingPiece], tmp_path: Path
) -> None:
    move(tmp_path, timings["apt-s", 3].parts[2])
    table = table_in(section(tmp_path), BY_DOMAINS)
    assert [cell(table, "made on", "apt-s", count).text for count in "123"] == ["1", "1", "1, 2"]

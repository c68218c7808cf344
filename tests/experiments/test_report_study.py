"""Probes along a training, as the report of a study draws them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from report_reading import cell, table_in

from crptpro.experiments.report import study
from crptpro.experiments.report.blocks import ABSENT, Figure, Paragraph
from crptpro.experiments.report.diagnostics import diagnostics, left_plateau
from crptpro.experiments.report.each_encoder import each_encoder
from crptpro.experiments.report.glance import glance
from crptpro.experiments.report.measurements import Row
from crptpro.experiments.report.reading import Asked, Made, Wanted
from crptpro.experiments.report.study import _along
from crptpro.experiments.report.trials import Trial, changes, readings


def row(updates: int, r2: str) -> Row:
    place = {"factor": "batch_size", "value": "128", "updates": updates, "encoder_seed": 0}
    goal = Wanted("crptpro", place, Made("probe-x", Path("probe-x"), {"kind": "probe"}, {}))
    read = {"domain": "walker", "colors": "normal", "embedding": "features", "measure": "r2_velocity"}
    return Row(goal, {**read, "value": r2})


def test_an_r2_of_zero_is_a_point_and_a_missing_one_a_gap() -> None:
    (figure,) = _along([row(1, "0.0"), row(2, ""), row(3, "0.5")], "figure", "")
    assert isinstance(figure, Figure)
    drawn = figure.drawing.axes[0].lines[0].get_ydata()
    assert drawn[0] == 0.0
    assert drawn[1] != drawn[1]  # not a number
    assert drawn[2] == 0.5


def record(*losses: float, uniform: str = "4.0") -> list[dict[str, str]]:
    """A row per hundred updates, with losses as shares of ln M."""
    return [
        {"updates": str(100 * (n + 1)), "comp": str(4.0 * share), "ln_num_prototypes": uniform}
        for n, share in enumerate(losses)
    ]


@pytest.mark.parametrize(
    ("losses", "left"),
    [
        ((1.02, 1.0, 0.985, 0.9), 300),
        ((0.9, 1.0, 0.995, 0.98), 400),  # what it was before the plateau does not count
        ((1.0, 0.98, 0.995), None),  # back on it
        ((1.0, 1.0), None),
        ((0.8, 0.7), 100),
    ],
)
def test_a_plateau_is_left_where_the_loss_stays_below_it(losses: tuple[float, ...], left: int | None) -> None:
    assert left_plateau(record(*losses)) == left


def test_the_table_of_diagnostics_says_when_the_plateau_was_left_and_by_how_many_encoders() -> None:
    made = Made("encoder-x", Path("encoder-x"), {}, {})
    records = {
        "all": [record(1.0, 0.9), record(1.0, 1.0, 0.9)],
        "one": [record(1.0, 0.9), record(1.0, 1.0)],
        "none": [record(1.0, 1.0)],
        "no prototypes": [record(1.0, uniform="")],
    }
    rows = [(Wanted(name, {}, made), each) for name, several in records.items() for each in several]
    table = table_in(tuple(diagnostics(rows, lambda goal: goal.label, "value", "figure", "")), "at the end")
    found = {name: cell(table, "left the plateau at", name) for name in records}
    assert (found["all"].text, found["all"].beside) == ("250", "200 to 300")
    assert (found["one"].text, found["one"].beside) == ("200", "1 of 2 encoders")
    assert found["none"].text == "not left"
    assert found["no prototypes"].text == ABSENT


def probed(
    value: str, seed: int, updates: int, r2: dict[str, float | str], *, group: str = "A", factor: str = "tau"
) -> list[Row]:
    """An encoder's velocities, as read from its features on each domain."""
    place = {
        "factor": factor,
        "value": value,
        "usual": "0.1",
        "group": group,
        "encoder_seed": seed,
        "updates": updates,
    }
    key = f"probe-{value}-{group}{seed}-{updates}"
    cells = {"colors": "normal", "embedding": "features", "measure": "r2_velocity", "coordinate": ""}
    goal = Wanted("crptpro", place, Made(key, Path(key), {"kind": "probe"}, {}))
    return [Row(goal, {**cells, "domain": domain, "value": str(number)}) for domain, number in r2.items()]


def both(walker: float | str, finger: float | str) -> dict[str, float | str]:
    return {"walker": walker, "finger": finger}


MEASURE = ("r2_velocity", "features")
SHARP = {group: Trial("tau", "0.05", "0.1", group) for group in "AC"}
FOUND = readings(
    [
        *probed("0.1", 0, 100, both(0.1, 0.2)),
        *probed("0.1", 0, 300, both(0.2, 0.4)),
        *probed("0.1", 1, 300, both(0.3, 0.5)),
        *probed("0.05", 0, 100, both(0.3, 0.5)),
        *probed("0.05", 0, 300, both(0.3, 0.6)),
        *probed("0.05", 1, 300, both(0.2, 0.5)),
        *probed("0.05", 2, 300, both(0.9, 0.9)),  # nothing to compare with
        *probed("0.1", 0, 300, {"reacher": 0.4}, group="C"),
        *probed("0.05", 0, 300, {"reacher": 0.6}, group="C"),
        *probed("untrained", 0, 0, both(0.0, 0.1), factor="control"),
    ]
)


def test_encoders_are_compared_with_the_usual_ones_of_their_group_seed_and_updates() -> None:
    end = pytest.approx([0.45 - 0.3, 0.35 - 0.4])
    assert changes(FOUND, [SHARP["A"]], None, MEASURE) == end
    assert changes(FOUND, [SHARP["A"]], 300, MEASURE) == end
    assert changes(FOUND, [SHARP["A"]], 100, MEASURE) == pytest.approx([0.4 - 0.15])
    assert changes(FOUND, SHARP.values(), 300, MEASURE) == pytest.approx([0.45 - 0.3, 0.35 - 0.4, 0.6 - 0.4])
    assert changes(FOUND, SHARP.values(), 200, MEASURE) == []
    assert changes(FOUND, SHARP.values(), None, ("r2_velocity", "z")) == []


def test_ends_after_different_updates_do_not_compare() -> None:
    found = readings([*probed("0.1", 0, 300, both(0.1, 0.1)), *probed("0.05", 0, 200, both(0.2, 0.2))])
    assert changes(found, [SHARP["A"]], None, MEASURE) == []


def test_an_encoder_counts_once_it_is_probed_on_every_domain_of_its_group() -> None:
    part = [*probed("0.1", 0, 300, both(0.2, 0.4)), *probed("0.05", 0, 300, {"walker": 0.9})]
    assert [(reading.trial.value, reading.values[MEASURE]) for reading in readings(part)] == [
        ("0.1", pytest.approx(0.3))
    ]
    (reading,) = readings(probed("0.1", 0, 300, both(0.2, 0.4)) + probed("0.05", 0, 300, both(0.2, "")))
    assert reading.trial.is_usual


def test_a_glance_has_every_value_with_its_change_and_the_untrained_encoder_last() -> None:
    blocks = tuple(glance(FOUND, [], "study"))
    table = table_in(blocks, "at a glance")
    assert [[cell.text for cell in line[:4]] for line in table.rows] == [
        ["tau", "0.1 (usual)", "A", "2"],
        ["tau", "0.05", "A", "3"],
        ["tau", "0.1 (usual)", "C", "1"],
        ["tau", "0.05", "C", "1"],
        [ABSENT, "untrained", "A", "1"],
    ]
    read = [line[table.columns.index("velocities, features")] for line in table.rows]
    assert [(cell.text, cell.beside) for cell in read] == [
        ("0.350", ""),
        ("0.567", "+0.050"),
        ("0.400", ""),
        ("0.600", "+0.200"),
        ("0.050", ""),
    ]
    assert any(isinstance(block, Paragraph) and "one pair of encoders" in block.text for block in blocks)
    along = table_in(blocks, "velocities from features against the usual")
    assert along.columns == ("factor", "value", "pairs", "100", "300")
    assert [(c.text, c.beside) for c in along.rows[0][3:]] == [
        ("+0.250", ""),
        ("+0.100", "-0.050 to +0.200"),
    ]
    assert [[cell.text for cell in line[:3]] for line in along.rows] == [["tau", "0.05", "3"]]
    (figure,) = (block for block in blocks if isinstance(block, Figure))
    marks = figure.drawing.axes[0].lines
    assert marks[0].get_xdata()[0] == pytest.approx(0.25)
    assert marks[1].get_xdata()[0] == pytest.approx(0.1)
    assert [label.get_text() for label in figure.drawing.axes[0].get_yticklabels()] == ["tau 0.05 (3 pairs)"]


def test_what_encoders_know_at_the_end_is_not_said_of_those_that_are_not_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at_end = probed("0.1", 0, 300, both(0.2, 0.4))
    on_the_way = probed("0.05", 0, 100, both(0.7, 0.9))
    to_come = probed("0.05", 0, 300, both("", ""))[0].goal
    goals = [at_end[0].goal, on_the_way[0].goal, replace(to_come, piece=replace(to_come.piece, done=None))]
    monkeypatch.setattr(study, "rows_of", lambda *_: ([*at_end, *on_the_way], []))
    blocks = study.study(Asked("study", "small", tuple(goals)))
    table = table_in(blocks, "read from features at the end")
    assert [line[0].text for line in table.rows] == ["0.1"]
    along = [block for block in blocks if isinstance(block, Figure) and "along training" in block.caption]
    assert len(along) == 1


def test_there_is_no_glance_where_nothing_is_the_usual_value() -> None:
    assert glance([reading for reading in FOUND if not reading.trial.is_usual], [], "study") == []


def test_every_encoder_has_a_line_of_its_own_along_its_training_and_the_untrained_the_same_number_in_each() -> (
    None
):
    of_group = [reading for reading in FOUND if reading.trial.group == "A"]
    goal = probed("0.05", 0, 300, both(0.3, 0.6))[0].goal
    records = [(goal, record(1.0, 0.9))]
    (table,) = each_encoder(of_group, records, "tau", "tau, group A: ")
    assert table.caption.startswith("Tau, group A: velocities read from features of each encoder")
    assert table.columns == ("tau", "encoder seed", "left the plateau at", "100", "300")
    assert [[cell.text for cell in line] for line in table.rows] == [
        ["0.1", "0", ABSENT, "0.150", "0.300"],
        ["0.1", "1", ABSENT, ABSENT, "0.400"],
        ["0.05", "0", "200", "0.400", "0.450"],
        ["0.05", "1", ABSENT, ABSENT, "0.350"],
        ["0.05", "2", ABSENT, ABSENT, "0.900"],
        ["untrained", "0", ABSENT, "0.050", "0.050"],
    ]


def test_encoders_that_were_probed_at_their_end_alone_have_no_table_along_training() -> None:
    ends = [reading for reading in FOUND if reading.updates != 100]
    assert each_encoder(ends, [], "tau", "") == []

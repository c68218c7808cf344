"""State probes as the report shows them: which cells stand beside each other, and on how many encoders."""

from __future__ import annotations

from pathlib import Path

import pytest
from report_reading import cell, table_in, words

from crptpro.experiments.report.blocks import Block, Figure
from crptpro.experiments.report.probes import probes
from crptpro.experiments.report.reading import Asked, Made, Wanted

HEADER = "domain,seen,colors,embedding,measure,coordinate,value\n"


def probed(
    root: Path, label: str, domain: str, r2: float, *, group: str = "A", colors: str = "normal", seed: int = 0
) -> Wanted:
    key = f"probe-{label}-{group}-{domain}-{colors}-{seed}"
    (root / key).mkdir()
    lines = [
        f"{domain},yes,{colors},features,r2_position,,{r2 / 2}",
        f"{domain},yes,{colors},features,r2_velocity,hinge,0.99",
        f"{domain},yes,{colors},features,r2_velocity,,{r2}",
    ]
    (root / key / "probe.csv").write_text(HEADER + "\n".join(lines) + "\n")
    place = {"group": group, "encoder_seed": seed}
    return Wanted(label, place, Made(key, root / key, {"kind": "probe"}, {"seconds": 1.0}))


def blocks_of(*goals: Wanted) -> tuple[Block, ...]:
    asked = Asked("probe", "small", goals)
    return probes(asked)


def figure_of(blocks: tuple[Block, ...]) -> Figure:
    (figure,) = [block for block in blocks if isinstance(block, Figure)]
    return figure


def test_other_colours_of_a_domain_stand_beside_its_own(tmp_path: Path) -> None:
    blocks = blocks_of(
        probed(tmp_path, "atc", "walker", 0.4, colors="reversed_background"),
        probed(tmp_path, "atc", "walker", 0.5),
        probed(tmp_path, "atc", "cheetah", 0.6),
    )
    columns = table_in(blocks, "R2 of velocities").columns
    assert columns == ("encoder", "group", "cheetah", "walker", "walker, reversed background")


def test_one_number_of_encoders_is_said_once_and_several_in_every_cell(tmp_path: Path) -> None:
    goals = [probed(tmp_path, "atc", domain, 0.4) for domain in ("walker", "cheetah")]
    table = table_in(blocks_of(*goals), "R2 of velocities")
    assert "(n = 1)" in table.caption
    assert cell(table, "walker", "atc", "A").beside == "seen"
    table = table_in(blocks_of(*goals, probed(tmp_path, "atc", "walker", 0.6, seed=1)), "R2 of velocities")
    assert "(n = 1 to 2)" in table.caption
    assert cell(table, "walker", "atc", "A").beside == "seen, n = 2"
    assert cell(table, "walker", "atc", "A").text == "0.500 ± 0.141"
    assert cell(table, "cheetah", "atc", "A").beside == "seen, n = 1"


def test_a_page_says_what_was_held_out_and_how_means_are_made(tmp_path: Path) -> None:
    goal = probed(tmp_path, "atc", "walker", 0.4)
    path = goal.piece.directory / "probe.csv"
    rows = path.read_text().replace(HEADER.strip(), HEADER.strip() + ",samples,held_out_episodes")
    path.write_text(
        "".join(f"{line},2000,10\n" if i else f"{line}\n" for i, line in enumerate(rows.splitlines()))
    )
    told = words(blocks_of(goal))
    assert "2,000 observations per probe, 10 episodes of them held out" in told
    assert "counts a negative one as 0" in told
    assert "may have seen these very observations" in told


def test_the_figure_has_every_encoder_in_every_row_and_leaves_gaps(tmp_path: Path) -> None:
    figure = figure_of(
        blocks_of(
            probed(tmp_path, "crptpro", "walker", 0.4),
            probed(tmp_path, "crptpro", "walker", 0.6, seed=1),
            probed(tmp_path, "crptpro", "cheetah", 0.8),
            probed(tmp_path, "random-encoder", "walker", 0.2),
        )
    )
    positions, velocities = figure.drawing.axes
    assert [tick.get_text() for tick in positions.get_yticklabels()] == ["cheetah", "walker"]
    assert [axis.get_xlabel() for axis in (positions, velocities)] == ["R2 of positions", "R2 of velocities"]
    trained, control = (line.get_xdata() for line in velocities.lines)
    assert list(trained) == pytest.approx([0.8, 0.5])
    assert list(control) == pytest.approx([float("nan"), 0.2], nan_ok=True)
    assert list(positions.lines[0].get_xdata()) == pytest.approx([0.4, 0.25])
    assert "n = 1 to 2" in figure.caption


def test_marks_of_one_row_do_not_hide_each_other(tmp_path: Path) -> None:
    figure = figure_of(
        blocks_of(*(probed(tmp_path, label, "walker", 0.5) for label in ("crptpro", "atc", "becl")))
    )
    heights = [float(line.get_ydata()[0]) for line in figure.drawing.axes[0].lines]
    assert len(set(heights)) == 3
    assert max(abs(height) for height in heights) < 0.5  # within the row


def test_encoders_of_several_groups_are_told_apart(tmp_path: Path) -> None:
    goals = [probed(tmp_path, "atc", "walker", 0.4, group=group) for group in ("A", "D")]
    blocks = blocks_of(*goals)
    assert [line.get_xdata()[0] for line in figure_of(blocks).drawing.axes[1].lines] == [0.4, 0.4]
    names = [text.get_text() for text in figure_of(blocks).drawing.legends[0].get_texts()]
    assert names == ["atc, A", "atc, D"]
    assert cell(table_in(blocks, "R2 of velocities"), "walker", "atc", "D").text == "0.400"

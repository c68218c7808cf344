"""Prototypes, coverage and embeddings in a report: each piece once, however many places it stands in."""

from __future__ import annotations

from pathlib import Path

from report_reading import cell, table_in

from crptpro.experiments.report.blocks import Block, Figure
from crptpro.experiments.report.measurements import RANDOM, coverage, embeddings, prototypes
from crptpro.experiments.report.reading import Asked, Made, Wanted

PROTOTYPES = "method,has_dispersion,updates,kne_3,kne_half,ane,intr\n"
COVERAGE = "source,method,domain,env_steps,coverage,samples\n"


def made(root: Path, kind: str, name: str, text: str, **description: object) -> Made:
    directory = root / f"{kind}-{name}"
    directory.mkdir()
    (directory / f"{kind}.csv").write_text(text)
    return Made(directory.name, directory, {"kind": kind, **description}, {"seconds": 1.0})


def figure_of(blocks: tuple[Block, ...]) -> Figure:
    (figure,) = [block for block in blocks if isinstance(block, Figure)]
    return figure


def test_prototypes_of_one_encoder_in_two_groups_are_one_curve_in_both(tmp_path: Path) -> None:
    rows = PROTOTYPES + "proto-rl-s,False,50,1e-4,1e-4,1e-4,1e-4\nproto-rl-s,False,100,1e-4,1e-4,2e-4,1e-4\n"
    piece = made(tmp_path, "prototypes", "walker", rows)
    goals = tuple(Wanted("proto-rl-s", {"group": group}, piece) for group in "AD")
    blocks = prototypes(Asked("prototypes", "small", goals))
    table = table_in(blocks, "Spread of the prototypes")
    assert cell(table, "group", "proto-rl-s without L_intr").text == "A, D"
    assert cell(table, "encoders", "proto-rl-s without L_intr").text == "1"
    for axes in figure_of(blocks).drawing.axes:
        (line,) = axes.get_lines()
        assert list(line.get_xdata()) == [50, 100]


def test_random_data_beside_several_explorers_counts_once_and_the_axis_is_the_explorer_s(
    tmp_path: Path,
) -> None:
    data = [{"kind": "dataset", "domain": "walker", "seed": 0}]
    goals = []
    for method, env_steps in (("proto-rl-c", 40_002), ("proto-rl-s", 40_000)):
        rows = f"random,,walker,{env_steps},0.2,512\nexplorer,{method},walker,{env_steps},0.3,512\n"
        piece = made(
            tmp_path, "coverage", method, COVERAGE + rows, datasets=data, explorer={"method": method}
        )
        goals.append(Wanted(method, {"group": "A"}, piece))
    blocks = coverage(Asked("coverage", "small", (*goals, goals[0])))
    table = table_in(blocks, "Coverage at the end")
    assert cell(table, "runs", "walker", RANDOM).text == "1"
    assert cell(table, "runs", "walker", "proto-rl-s explorer").text == "1"
    steps = "explorer's env steps, all domains"
    assert cell(table, steps, "walker", RANDOM).text == "40,000 or 40,002"
    assert "last window" in table.caption
    (axes,) = figure_of(blocks).drawing.axes
    assert axes.get_xlabel() == "env steps of the explorer, all domains"
    assert len(axes.get_lines()) == 4


def test_embeddings_of_a_piece_that_was_asked_for_twice_are_drawn_once(tmp_path: Path) -> None:
    piece = made(tmp_path, "embeddings", "x", "source,pc1,pc2,pc3\nwalker,1,2,3\n")
    goals = tuple(Wanted("crptpro", {"group": group}, piece) for group in "AD")
    assert "of 1 embeddings" in figure_of(embeddings(Asked("visualize", "small", goals))).caption

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from fake_reproduction import Reproduction, write_run
from matplotlib.image import imread
from report_reading import Parsed, blocks_of, cell, page_of, table_in, tables_in, words

from crptpro.errors import RecordError
from crptpro.experiments.goals import Goal, Request
from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.matrix import seen
from crptpro.experiments.pieces import settings
from crptpro.experiments.report import build_report
from crptpro.experiments.report.blocks import Page
from crptpro.experiments.scales import SMALL

pytestmark = pytest.mark.slow  # the page with everything takes a while to be made

FIGURES = 30
"""At least so many figures has a page with every experiment."""


@pytest.fixture(scope="module")
def root(whole_report: Path) -> Path:
    return whole_report.parent.parent


@pytest.fixture(scope="module")
def report(whole_report: Path) -> Path:
    return whole_report.parent


@pytest.fixture(scope="module")
def page(root: Path) -> Page:
    return page_of(root, replicates=50)


@pytest.fixture(scope="module")
def html(report: Path) -> Parsed:
    return Parsed((report / "index.html").read_text())


def test_the_page_needs_nothing_but_itself(html: Parsed, report: Path) -> None:
    outside = [ref for ref in html.references if not ref.startswith(("#", "data:image/"))]
    assert outside == []
    assert not {"script", "link", "iframe", "object", "embed"} & set(html.tags)
    assert "@import" not in (report / "index.html").read_text()


def test_every_link_leads_somewhere_and_no_name_is_used_twice(html: Parsed) -> None:
    assert len(set(html.ids)) == len(html.ids)
    assert {ref[1:] for ref in html.references if ref.startswith("#")} <= set(html.ids)


def test_every_experiment_has_its_section_and_every_piece_its_card(html: Parsed, root: Path) -> None:
    asked = {path.stem for path in (root / "experiments").glob("*.json")}
    assert len(asked) == 14
    assert asked <= set(html.ids)
    assert {f"piece-{path.name}" for path in (root / "pieces").iterdir()} <= set(html.ids)


def test_markdown_has_the_numbers_of_every_table(page: Page, html: Parsed, report: Path) -> None:
    written = (report / "report.md").read_text().replace("&amp;", "&").replace("&lt;", "<")
    shown = {" ".join(row) for row in html.rows}
    count = 0
    for section in page.sections:
        for table in tables_in(section.blocks):
            for row in table.rows:
                texts = [
                    part
                    for c in row
                    for part in (c.text, c.beside, f"paper {c.published}" * bool(c.published))
                ]
                assert " ".join(part for part in texts if part) in shown
                line = "| " + " | ".join(
                    " · ".join(p for p in (c.text, c.beside, f"paper {c.published}" * bool(c.published)) if p)
                    for c in row
                )  # fmt: skip
                assert line in written
                count += 1
    assert count > 200


def test_figures_are_files_and_show_something(report: Path, html: Parsed) -> None:
    drawn, lines = sorted((report / "figures").glob("*.png")), sorted((report / "figures").glob("*.svg"))
    assert [path.stem for path in drawn] == [path.stem for path in lines]
    assert len(drawn) >= FIGURES
    for path in drawn:
        assert len(np.unique(imread(path)[..., 0])) > 20, path
    for path in lines:
        assert len(list(ElementTree.parse(path).iter())) > 20, path
    written = (report / "report.md").read_text()
    assert set(re.findall(r"\]\((figures/[^)]+)\)", written)) == {f"figures/{path.name}" for path in drawn}
    photos = [ref for ref in html.references if ref.startswith("data:image/png;base64,")]
    shown = [imread(io.BytesIO(base64.b64decode(ref.split(",", 1)[1]))) for ref in photos]
    assert min(picture.shape[0] for picture in shown) > 0
    assert html.tags.count("svg") >= FIGURES - 2


def test_data_and_videos_are_shown(page: Page) -> None:
    (stacks,) = blocks_of(page, "observations")
    assert [axis.get_ylabel() for axis in stacks.drawing.axes if axis.get_ylabel()] == [
        "cheetah", "quadruped", "walker",
    ]  # fmt: skip
    (strip,) = blocks_of(page, "videos")
    titles = [axis.get_title(loc="left") for axis in strip.drawing.axes]
    assert titles[0].startswith("crptpro on A walker_run: env steps 00020000")
    shown = [axis.images[0].get_array() for axis in strip.drawing.axes[:8]]
    places = [int(np.argmax(np.asarray(picture).mean(axis=(0, 2)))) for picture in shown]
    assert places == sorted(places)
    assert places[0] < places[-1]  # the bar travels


def test_budgets_stand_beside_the_papers_and_limits_are_said(page: Page) -> None:
    blocks = blocks_of(page, "caveats")
    budgets = table_in(blocks, "Budgets")
    assert [c.text for c in budgets.rows[0]] == ["random transitions per domain", "20,000", "130", "100,000"]
    assert cell(budgets, "small", "DrQ's env steps").text == "20,000"
    assert cell(budgets, "the paper's", "DrQ's env steps").text == "1,000,000"
    assert "What this cannot show" in words(blocks)


def test_an_experiment_without_anything_gets_one_line(page: Page) -> None:
    (line,) = blocks_of(page, "seen-tiny")
    assert line.text == "Nothing is finished yet: 6 pieces were asked for."


def test_cost_stands_beside_the_papers(page: Page) -> None:
    table = table_in(blocks_of(page, "efficiency-small"), "by number of domains")
    hours = cell(table, "hours, paper's budget", "apt-s", "3")
    assert (hours.text, hours.published) == ("92.7", "61.8")
    assert cell(table, "encoder updates, paper's budget", "apt-s", "3").published == "375,000"


def test_spread_of_prototypes_is_in_the_papers_units(page: Page) -> None:
    table = table_in(blocks_of(page, "prototypes-small"), "Spread of the prototypes")
    ane = cell(table, "ANE", "crptpro with L_intr")
    assert (ane.text, ane.published) == ("4.000", "7.996")  # 1e-3 - 3000 * 2e-7 = 4e-4
    assert cell(table, "L_intr", "proto-rl-s without L_intr").published == "-80.839"
    assert cell(table, "KNE, k = M/2", "crptpro with L_intr").published == ""


def test_coverage_probe_stability_and_study_have_their_numbers(page: Page) -> None:
    covered = table_in(blocks_of(page, "coverage-small"), "Coverage at the end")
    assert cell(covered, "coverage", "walker", "random policy").text == f"{2 + np.log1p(40_000) / 8:.4f}"
    probed = blocks_of(page, "probe-small")
    assert cell(table_in(probed, "R2 of velocities, features"), "walker", "crptpro", "A").text == "0.400"
    assert cell(table_in(probed, "R2 of positions, embedding z"), "cheetah", "crptpro", "A").beside == "seen"
    assert "cheetah, reversed background" in table_in(probed, "R2 of positions, features").columns
    finals = table_in(blocks_of(page, "stability-small"), "Diagnostics at the end")
    last = np.mean([np.log(128) * (1 - (updates - 200) / 1000) for updates in (920, 940, 960, 980, 1000)])
    assert cell(finals, "comparative loss [nats]", "crptpro").text == f"{last:.4g}"
    tried = blocks_of(page, "study-small")
    assert cell(table_in(tried, "diagnostics at the end"), "encoders", "0.05").text == "2"
    probed = cell(table_in(tried, "velocities read from features at the end"), "walker", "annealed")
    assert (probed.text, probed.beside) == ("0.700 / 0.400", "± 0.000 / 0.000, n = 2")
    gained = cell(
        table_in(tried, "at a glance"), "velocities, features", "assignment temperature", "annealed"
    )
    assert (gained.text, gained.beside) == ("0.400", "+0.200")


def test_the_same_directory_gives_the_same_figures(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_run(tmp_path / f"run_{seed}", method="atc", task="walker_run", score=100 + 10 * seed, seed=seed)
    first, again = (build_report(tmp_path, out=tmp_path / name).parent for name in ("first", "again"))
    for path in (first / "figures").iterdir():
        assert path.read_bytes() == (again / "figures" / path.name).read_bytes(), path.name


def test_names_from_files_never_become_markup(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = seen(Request(SMALL, groups=("A",), tasks=("walker_run",), methods=("crptpro",), seeds=(0, 1)))
    evil = '<script>alert("1")</script> & | [x](http://a.b)'
    renamed = [Goal(evil, goal.piece, settings(**{**dict(goal.place), "group": "<b>"})) for goal in goals]
    made.ask("seen", renamed)
    made.run(goals[0], 100)
    made.run(goals[1], 120)
    folder = build_report(tmp_path, bootstrap=Bootstrap(replicates=20)).parent
    parsed = Parsed((folder / "index.html").read_text())
    assert "script" not in parsed.tags
    assert "b" not in parsed.tags
    assert any(evil in row for row in parsed.rows)
    assert "<script" not in (folder / "report.md").read_text()


def test_a_damaged_request_and_a_damaged_piece_are_named(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = seen(Request(SMALL, groups=("A",), tasks=("walker_run",), methods=("crptpro",), seeds=(0,)))
    made.ask("seen", goals)
    directory = made.run(goals[0], 100)
    (directory / "done.json").write_text("{")
    (tmp_path / "experiments" / "probe-small.json").write_text('{"experiment": "probe"}')
    page = page_of(tmp_path)
    said = words(blocks_of(page, "contents"))
    assert "probe-small.json does not say what was asked for" in said
    assert "done.json cannot be read as JSON" in said
    assert "Nothing is finished yet" in words(blocks_of(page, "seen-small"))


def test_nothing_to_report_on_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="There is no directory"):
        build_report(tmp_path / "nowhere")
    with pytest.raises(RecordError, match="holds nothing to report on"):
        build_report(tmp_path)
    assert list(tmp_path.iterdir()) == []

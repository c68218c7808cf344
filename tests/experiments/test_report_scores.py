from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import pytest
from fake_reproduction import Reproduction, write_run
from report_reading import blocks_of, cell, page_of, table_in, tables_in, words

from crptpro.experiments.goals import Goal, Request
from crptpro.experiments.matrix import colors, seen, sensitivity
from crptpro.experiments.pieces import settings
from crptpro.experiments.records import read_run
from crptpro.experiments.report.blocks import Figure
from crptpro.experiments.report.learning import active_seconds, common_curve
from crptpro.experiments.report.runs import Spot, printed, published
from crptpro.experiments.scales import SMALL

SCORES = {
    ("crptpro", "cheetah_run"): (100, 200, 300, 400),
    ("crptpro", "walker_run"): (100, 100, 100, 100),
    ("atc", "cheetah_run"): (50, 50, 50, 50),
    ("atc", "walker_run"): (60, 60, 60, 60),
    ("drq", "cheetah_run"): (500, 500, 500, 500),
    ("drq", "walker_run"): (200, 200, 200, 200),
}
FINAL, LATE = "at the final evaluation", "over the last 10 evaluations"


def place(goal: Goal, name: str) -> object:
    return dict(goal.place).get(name)


def fill(root: Path, encoder_seeds: tuple[int, ...] = (0, 1), **left_out: str) -> Reproduction:
    made = Reproduction(root)
    tasks, methods = ("cheetah_run", "walker_run"), ("crptpro", "atc", "drq")
    goals = seen(
        Request(SMALL, groups=("A",), tasks=tasks, methods=methods, encoder_seeds=encoder_seeds, seeds=(0, 1))
    )
    made.ask("seen", goals)
    waiting = {cell: list(scores) for cell, scores in SCORES.items()}
    for goal in goals:
        score = waiting[goal.label, str(place(goal, "task"))].pop(0)
        if left_out.get("label") == goal.label and left_out.get("task") == place(goal, "task"):
            continue
        made.run(goal, score)
    return made


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> tuple:
    return blocks_of(page_of(fill(tmp_path_factory.mktemp("root")).root), "seen-small")


def test_a_score_is_mean_and_deviation_over_runs_with_their_number_and_the_papers(blocks: tuple) -> None:
    found = cell(table_in(blocks, FINAL), "crptpro", "A", "cheetah_run")
    # sqrt(((-150)^2 + 50^2 + 50^2 + 150^2) / 3) = 129.1
    assert (found.text, found.beside, found.published) == ("250 ± 129", "n = 4", "611 ± 44")
    assert cell(table_in(blocks, FINAL), "atc", "A", "walker_run").published == "271 ± 16"
    assert cell(table_in(blocks, FINAL), "drq", "A", "cheetah_run").published == "807 ± 75"


def test_the_late_score_averages_ten_evaluations_of_a_curve_that_rises_linearly(blocks: tuple) -> None:
    # 0.1, 0.2, ..., 1.0 of the score: 0.55 on average
    assert cell(table_in(blocks, LATE), "drq", "A", "walker_run").text == "110 ± 0"


def test_aggregates_are_those_of_the_runs_beside_the_papers_on_the_same_rows(blocks: tuple) -> None:
    table = table_in(blocks, "Over the 2 tasks")
    assert cell(table, "runs", "crptpro").text == "8"
    assert cell(table, "mean score", "crptpro").text == "175"
    assert cell(table, "mean score", "crptpro").published == "562"  # (611 + 513) / 2
    ratio = (250 / 807 + 100 / 485) / 2
    assert cell(table, "mean / DrQ", "crptpro").text == f"{ratio:.3f}"
    assert cell(table, "mean / DrQ", "crptpro").published == f"{(611 / 807 + 513 / 485) / 2:.3f}"
    assert cell(table, "optimality gap", "crptpro").text == f"{1 - ratio:.3f}"
    assert cell(table, "median / DrQ", "crptpro").text == f"{ratio:.3f}"
    # the middle half of 100/807, 200/807, 4 times 100/485, 300/807, 400/807, sorted
    assert cell(table, "IQM / DrQ", "crptpro").text == f"{(3 * 100 / 485 + 200 / 807) / 4:.3f}"
    assert cell(table, "mean / DrQ here", "crptpro").text == f"{(250 / 500 + 100 / 200) / 2:.3f}"
    assert (cell(table, "mean / DrQ here", "drq").text, cell(table, "mean / DrQ here", "drq").beside) == (
        "1", "by definition",
    )  # fmt: skip
    assert (
        cell(table, "mean / DrQ", "atc").beside
        == f"[{(50 / 807 + 60 / 485) / 2:.3f}, {(50 / 807 + 60 / 485) / 2:.3f}]"
    )


def test_intervals_of_few_runs_are_called_too_narrow(blocks: tuple) -> None:
    assert "Tasks have as few as 4 runs" in words(blocks)
    assert "2: 50%" in words(blocks)


def test_intervals_over_encoders_stand_where_runs_share_several(blocks: tuple, tmp_path: Path) -> None:
    table = table_in(blocks, "where runs share encoders")
    assert [row[0].text for row in table.rows] == ["crptpro", "atc"]
    assert cell(table, "encoders", "crptpro").text == "2"
    low, high = cell(table, "mean / DrQ", "crptpro").beside.strip("[]").split(", ")
    assert float(low) < float(high)
    alone = blocks_of(page_of(fill(tmp_path, encoder_seeds=(0,)).root), "seen-small")
    assert not [t for t in tables_in(alone) if "share encoders" in t.caption]
    # DrQ's runs have encoders of their own: intervals over them speak of the method.
    assert "The intervals of crptpro, atc are over runs alone, and speak of these encoders" in words(alone)
    assert "speak of these encoders" not in words(blocks)


def test_wider_intervals_are_those_over_encoders_also_against_drq_and_of_curves(blocks: tuple) -> None:
    over_runs, over_encoders = (
        table_in(blocks, caption) for caption in ("Over the 2 tasks", "where runs share encoders")
    )
    for column in ("mean score", "mean / DrQ here"):
        one, other = (ends(cell(table, column, "crptpro").beside) for table in (over_runs, over_encoders))
        assert other[1] - other[0] > one[1] - one[0] > 0
    assert cell(over_encoders, "mean / DrQ here", "crptpro").text == "0.500"  # 250 / 500 and 100 / 200
    curves = next(b for b in blocks if isinstance(b, Figure) and b.name == "seen-small-curves")
    assert "over encoders where runs of a panel share several" in curves.caption
    band = curves.drawing.axes[0].collections[0].get_paths()[0].vertices[:, 1]
    # Encoders of (100, 200) and (300, 400): a replicate of one of them has runs of 100 to 200 or of 300 to 400.
    assert band.max() > 350


def ends(interval: str) -> list[float]:
    return [float(end) for end in interval.strip("[]").split(", ")]


def test_improvement_compares_every_pair_of_runs(blocks: tuple) -> None:
    table = table_in(blocks, "Probability that a run of crptpro")
    assert cell(table, "P(crptpro > other)", "atc").text == "1.00"
    assert cell(table, "P(crptpro > other)", "drq").text == "0.00"
    assert cell(table, "runs of both", "atc").text == "16"
    assert cell(table, "interval over", "atc").text == "encoders"


def test_every_figure_says_how_many_runs_it_shows(blocks: tuple) -> None:
    figures = {block.name: block for block in blocks if isinstance(block, Figure)}
    assert set(figures) == {
        "seen-small-improvement", "seen-small-profiles", "seen-small-curves", "seen-small-curves-time",
    }  # fmt: skip
    legend = [text.get_text() for text in figures["seen-small-curves"].drawing.legends[0].get_texts()]
    assert legend == ["crptpro (n = 4)", "atc (n = 4)", "drq (n = 4)"]
    assert "24 runs in all" in figures["seen-small-improvement"].caption


def test_what_is_missing_is_counted_named_and_not_made_up(tmp_path: Path) -> None:
    blocks = blocks_of(page_of(fill(tmp_path, label="atc", task="walker_run").root), "seen-small")
    assert "20 of 24 pieces are there; missing: atc 4" in words(blocks)
    missing = table_in(blocks, "Not finished")
    assert [row[0].text for row in missing.rows] == ["atc"] * 4
    assert all("task walker_run" in row[1].text and row[2].text == "not begun" for row in missing.rows)
    empty = cell(table_in(blocks, FINAL), "atc", "A", "walker_run")
    assert (empty.text, empty.beside, empty.published) == ("\N{EN DASH}", "", "271 ± 16")
    assert "Left out of everything that compares methods: A walker_run (no run of atc)" in words(blocks)
    assert cell(table_in(blocks, "Over the 1 task"), "mean score", "crptpro").text == "250"


def test_a_single_run_has_no_deviation_and_no_interval(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = seen(Request(SMALL, groups=("A",), tasks=("walker_run",), methods=("crptpro",), seeds=(0,)))
    made.ask("seen", goals)
    made.run(goals[0], 300)
    blocks = blocks_of(page_of(tmp_path), "seen-small")
    assert cell(table_in(blocks, FINAL), "crptpro", "A", "walker_run").text == "300"
    assert "no interval" in cell(table_in(blocks, "Over the 1"), "mean score", "crptpro").beside


def test_a_finished_run_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    made = fill(tmp_path)
    (broken,) = (tmp_path / "pieces").glob("run-cheetah_run-atc-encoder-0-seed-0-*")
    (broken / "eval.csv").write_text("torn")
    blocks = blocks_of(page_of(made.root), "seen-small")
    assert "Finished, but not readable" in words(blocks)
    assert "ends within a row" in words(blocks)
    assert cell(table_in(blocks, FINAL), "atc", "A", "cheetah_run").beside == "n = 3"


def test_published_numbers_belong_to_group_task_and_colours() -> None:
    assert printed(published(Spot("A", "walker_run"), "crptpro")) == "513 ± 33"
    assert printed(published(Spot("C", "walker_run"), "crptpro")) == "570 ± 26"  # unseen
    assert printed(published(Spot("C", "reach_duplo", "reversed_background"), "crptpro")) == "163 ± 16"
    assert printed(published(Spot("C", "reach_duplo"), "crptpro")) == "146 ± 31"
    assert published(Spot("C", "cheetah_run", "inverted"), "crptpro") is None
    assert published(Spot("A", "walker_run"), "random-encoder") is None
    assert published(Spot("A", "walker_run"), "proto-rl-s") is None
    assert printed(published(Spot("", "walker_run"), "drq")) == "485 ± 181"


def test_reversed_colours_stand_beside_the_papers_reversed_ones(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = colors(Request(SMALL, methods=("crptpro",), tasks=("cheetah_run",), seeds=(0, 1)))
    made.ask("colors", goals)
    for goal in goals:
        made.run(goal, 100)
    table = table_in(blocks_of(page_of(tmp_path), "colors-small"), FINAL)
    assert cell(table, "crptpro", "C", "cheetah_run", "reversed_background").published == "485 ± 26"


def test_a_sensitivity_study_is_one_table_and_one_figure_for_what_varies(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = sensitivity(Request(SMALL, tasks=("walker_run",), methods=("crptpro",), seeds=(0, 1)))
    made.ask("sensitivity", goals)
    for goal in goals:
        if not made.store.is_done(goal.piece):  # alpha 0.005 and b 20,000 are the same encoder
            made.run(goal, 485 if place(goal, "value") == "0.05" else 97)
    blocks = blocks_of(page_of(tmp_path), "sensitivity-small")
    alphas = table_in(blocks, f"{FINAL}, mean ± standard deviation over runs (n). alpha varied")
    assert cell(alphas, "A walker_run", "crptpro, alpha 0.05").text == "485 ± 0"
    assert [row[0].text for row in alphas.rows if "b " in row[0].text] == []
    figures = {block.name: block for block in blocks if isinstance(block, Figure)}
    (line,) = figures["sensitivity-small-alpha"].drawing.axes[0].get_lines()
    assert list(line.get_ydata()) == pytest.approx([0.2, 0.2, 0.2, 1.0, 0.2])  # 0, 0.0005, 0.005, 0.05, 0.5
    ticks = [tick.get_text() for tick in figures["sensitivity-small-b"].drawing.axes[0].get_xticklabels()]
    assert ticks == ["5000", "20000"]


def test_two_methods_of_one_base_have_a_line_each(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = sensitivity(Request(SMALL, tasks=("walker_run",), methods=("crptpro",), seeds=(0, 1)))
    mine = [
        Goal(goal.label.replace("crptpro", "crptpro-mine"), replace(goal.piece, seed=9 + i), goal.place)  # type: ignore[type-var]
        for i, goal in enumerate(goals)
    ]
    made.ask("sensitivity", [*goals, *mine])
    for goal in (*goals, *mine):
        if not made.store.is_done(goal.piece):
            made.run(goal, 97)
    blocks = blocks_of(page_of(tmp_path), "sensitivity-small")
    figures = {block.name: block for block in blocks if isinstance(block, Figure)}
    assert len(figures["sensitivity-small-alpha"].drawing.axes[0].get_lines()) == 2


def test_a_run_that_was_asked_for_under_other_seeds_counts_once(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = seen(Request(SMALL, groups=("A",), tasks=("walker_run",), methods=("drq",), seeds=(0, 1)))
    before = [replace(goal, place=settings(**{**dict(goal.place), "encoder_seed": 1})) for goal in goals]
    made.ask("seen", [*goals, *before])
    for goal, score in zip(goals, (100, 137)):
        made.run(goal, score)
    found = cell(table_in(blocks_of(page_of(tmp_path), "seen-small"), FINAL), "drq", "A", "walker_run")
    assert found.beside == "n = 2"


def test_encoders_fine_tuned_from_one_base_are_one_draw_of_its_pre_training(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    tasks = ("cheetah_run", "walker_run")
    request = Request(
        SMALL, groups=("A",), tasks=tasks, methods=("crptpro-finetune",), encoder_seeds=(0, 1), seeds=(0, 1)
    )
    goals = seen(request)
    made.ask("seen", goals)
    for i, goal in enumerate(goals):
        made.run(goal, 100 + 10 * i)
    table = table_in(blocks_of(page_of(tmp_path), "seen-small"), "where runs share encoders")
    assert cell(table, "encoders", "crptpro-finetune").text == "2"


def test_what_has_begun_has_said_or_timed_something(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = seen(Request(SMALL, groups=("A",), tasks=("walker_run",), methods=("drq",), seeds=(0, 1, 2)))
    made.ask("seen", goals)
    made.store.log(goals[0].piece).write_text("Learning.")
    made.run(goals[2], 100)
    missing = table_in(blocks_of(page_of(tmp_path), "seen-small"), "Not finished")
    assert [row[2].text for row in missing.rows] == ["begun, not finished", "not begun"]


def test_time_leaves_out_the_pause_of_a_run_that_was_continued(tmp_path: Path) -> None:
    for name, pause in (("straight", 0.0), ("continued", 50_000.0)):
        write_run(tmp_path / name, method="crptpro", task="walker_run", score=100, pause_s=pause)
    straight, continued = (active_seconds(read_run(tmp_path / name)) for name in ("straight", "continued"))
    assert straight[20_000] == pytest.approx(3600)
    assert straight[10_000] == continued[10_000] == pytest.approx(1800)
    assert continued[20_000] == pytest.approx(3600)


def test_curves_are_compared_where_all_runs_were_evaluated(tmp_path: Path) -> None:
    write_run(tmp_path / "a", method="crptpro", task="walker_run", score=100)
    run = read_run(tmp_path / "a")
    shorter = dataclasses.replace(run, episodes=run.episodes[:8])
    steps, returns = common_curve([run, shorter])
    assert list(steps) == [0, 2_000, 4_000, 6_000]
    assert returns[0].tolist() == returns[1].tolist() == pytest.approx([0, 10, 20, 30])


def test_runs_of_other_settings_are_not_taken_for_seeds_of_each_other(tmp_path: Path) -> None:
    for seed, (budget, score) in enumerate(((20_000, 60), (20_000, 80), (10_000, 20))):
        write_run(
            tmp_path / f"{seed}", method="crptpro", task="walker_run", score=score, seed=seed, budget=budget
        )
    path = tmp_path / "0" / "config.json"
    path.write_text(path.read_text().replace('"seed"', '"a_setting_of_later": 1, "seed"'))
    write_run(tmp_path / "cheetah", method="crptpro", task="cheetah_run", score=5, budget=10_000)
    write_run(tmp_path / "atc", method="atc", task="walker_run", score=40)
    table = table_in(blocks_of(page_of(tmp_path), "scores"), FINAL)
    assert cell(table, "crptpro, env_steps 20000", "walker_run").text == "70 ± 14"
    assert cell(table, "crptpro, env_steps 10000", "walker_run").text == "20"
    assert cell(table, "crptpro, env_steps 10000", "cheetah_run").text == "5.0"
    assert cell(table, "atc", "walker_run").text == "40"


def test_the_paper_s_means_over_all_of_its_tasks_are_those_that_it_printed(tmp_path: Path) -> None:
    made = Reproduction(tmp_path)
    goals = seen(Request(SMALL, methods=("apt-c",), seeds=(0,)))
    made.ask("seen", goals)
    for goal in goals:
        made.run(goal, 100)
    blocks = blocks_of(page_of(tmp_path), "seen-small")
    table = table_in(blocks, "Over the 12 tasks")
    assert cell(table, "mean score", "apt-c").published == "191"
    assert cell(table, "mean / DrQ", "apt-c").published == "0.412"  # its cells give 0.420
    assert "what its cells for these tasks give" not in table.caption


def test_any_directory_of_runs_gives_scores_and_curves(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_run(
            tmp_path / f"mine_{seed}", method="crptpro", task="walker_run", score=200 + 100 * seed, seed=seed
        )
        write_run(tmp_path / f"drq_{seed}", method="drq", task="walker_run", score=100, seed=seed)
    write_run(tmp_path / "going_on", method="crptpro", task="walker_run", score=900, seed=2)
    config = (tmp_path / "going_on" / "config.json").read_text()
    (tmp_path / "going_on" / "config.json").write_text(config.replace("20000", "40000"))
    page = page_of(tmp_path)
    assert "going_on is not finished: 20,000 of 40,000 env steps" in words(blocks_of(page, "contents"))
    assert "Made on A CPU, 2 cores, 24 GiB, no GPU, from source revision 0123456789ab" in words(
        blocks_of(page, "contents")
    )
    blocks = blocks_of(page, "scores")
    assert "It has numbers for CRPTpro" not in words(blocks)
    assert cell(table_in(blocks, FINAL), "crptpro", "walker_run").text == "250 ± 71"
    assert cell(table_in(blocks, FINAL), "crptpro", "walker_run").published == ""
    assert cell(table_in(blocks, FINAL), "drq", "walker_run").published == "485 ± 181"
    assert {block.name for block in blocks if isinstance(block, Figure)} >= {
        "runs-curves",
        "runs-curves-time",
    }
    assert "20,000 env steps; the paper's have 500,000" in words(blocks_of(page, "caveats"))
    assert table_in(blocks_of(page, "provenance"), "Hardware").rows[0][1].text == "4"

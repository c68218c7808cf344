"""The page on committed records, whose numbers it must give, and on made-up ones, where rules can be seen."""

from __future__ import annotations

import html
import math
import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from crptpro.artifact import write_json
from crptpro.errors import RecordError
from crptpro.experiments import figures
from crptpro.experiments.matrix import METHODS
from crptpro.experiments.measure import write_rows
from crptpro.experiments.report import build_report, left_plateau

RESULTS = Path(__file__).parents[2] / "results"
ENDS = "Group A: diagnostics at the end"
HARDWARE = {"cpu": "A CPU", "cpu_cores": 2, "ram_bytes": 24 * 2**30, "gpus": []}


class Report:
    """What a reader of ``report.md`` finds: its text, and tables by the beginning of their caption."""

    def __init__(self, page: Path) -> None:
        self.html, self.folder = page.read_text(), page.parent
        self.text = (page.parent / "report.md").read_text()
        self.tables: dict[str, pd.DataFrame] = {}
        blocks = re.findall(r"^(?:\*\*|<details><summary>)(.+?)(?:\*\*|</summary>)\n\n((?:\|.*\n)+)", self.text, re.M)
        for caption, table in blocks:
            lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in table.strip().split("\n")]
            head, _, *rows = [[cell.strip() for cell in line] for line in lines]
            self.tables[caption] = pd.DataFrame(rows, columns=head)

    def table(self, caption: str) -> pd.DataFrame:
        (found,) = [table for name, table in self.tables.items() if name.startswith(caption)]
        return found

    def cell(self, caption: str, column: str, *row: str) -> str:
        table = self.table(caption)
        for name, value in zip(table, row):
            table = table[table[name] == value]
        (found,) = table[column]
        return found


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Report:
    return Report(build_report(RESULTS / "seen_small", out=tmp_path_factory.mktemp("seen")))


# --- the committed records ------------------------------------------------------------------------------------------


def test_the_committed_page_is_what_the_committed_records_give(seen: Report) -> None:
    # After a change to the page: `crptpro report results/seen_small`, and read what changed.
    committed = (RESULTS / "seen_small" / "report" / "report.md").read_text()
    when = re.compile("Made on .* from seen_small")
    assert when.sub("", seen.text) == when.sub("", committed)


def test_both_files_show_every_table_and_figures_that_are_there(seen: Report) -> None:
    assert seen.html.count("<table>") == len(seen.tables)
    shown = re.findall(r"!\[.*\]\((.+?)\)", seen.text)
    assert re.findall(r'<img src="(.+?)"', seen.html) == shown
    assert {path.name for path in (seen.folder / "figures").iterdir()} == {Path(file).name for file in shown}
    for file in shown:
        assert len(np.unique(imread(seen.folder / file)[..., 0])) > 20, file
    assert len(shown) == 5


# --- made-up records ------------------------------------------------------------------------------------------------


def evaluations(score: float, *, method: str = "crptpro") -> list[dict]:
    """Eleven evaluations of two episodes, in which the return rises from 0 to a score."""
    return [
        {"env_steps": int(500_000 * share), "episode_return": score * share + other, "method": method}
        for share in np.linspace(0, 1, 11)
        for other in (-1, 1)
    ]


@dataclass
class Reproduction:
    """Jobs and requests of a root, written as ``crptpro reproduce`` writes them."""

    root: Path

    def job(
        self, key: str, kind: str, needs: Iterable[str] = (), *, done: bool = True, facts: Any = None, **tables: Any
    ) -> str:
        folder = self.root / "jobs" / key
        description = {"kind": kind, "command": [kind], "needs": list(needs), "facts": facts or {}}
        write_json(folder / "job.json", description)
        if done:
            made = {"seconds": 90.0, "attempts": 1, "device": "cpu", "threads": 1, "git_revision": "0123456789ab"}
            write_json(folder / "done.json", {**made, "versions": {"torch": "2.13.0"}, "hardware": HARDWARE})
        for name, rows in tables.items():
            write_rows(folder / f"{name}.csv", rows)
        return key

    def ask(self, experiment: str, cells: Iterable[tuple[str, str, Mapping[str, Any]]], scale: str = "paper") -> None:
        told = [{"label": label, "job": job, "place": dict(place)} for label, job, place in cells]
        content = {"experiment": experiment, "scale": scale, "request": {}, "cells": told}
        write_json(self.root / "experiments" / f"{len(list(self.root.glob('experiments/*')))}.json", content)

    def runs(self, label: str, task: str, scores: Iterable[float], **place: Any) -> list[tuple[str, str, dict]]:
        """Runs of a method, each on an encoder of its own."""
        cells = []
        for seed, score in enumerate(scores):
            encoder = self.job(f"encoder-{label}-{seed}", "encoder", facts={"method": label})
            key = f"run-{label}-{task}-{seed}-{'-'.join(map(str, place.values()))}"
            job = self.job(key, "run", [encoder], facts={"method": label}, eval=evaluations(score))
            cells.append((label, job, {"group": "A", "task": task, "encoder_seed": seed, "seed": 0, **place}))
        return cells

    def report(self) -> Report:
        return Report(build_report(self.root))


@pytest.fixture
def made(tmp_path: Path) -> Reproduction:
    return Reproduction(tmp_path)


def test_from_five_runs_on_every_task_aggregates_have_intervals(made: Reproduction) -> None:
    cells = made.runs("crptpro", "cheetah_run", [500, 550, 600, 650, 700])
    cells += made.runs("crptpro", "walker_run", [400, 450, 500, 550, 600])
    cells += made.runs("atc", "cheetah_run", [250, 260, 270, 280, 290])
    cells += made.runs("atc", "walker_run", [200, 210, 220, 230, 240])
    made.ask("seen", cells)
    report = made.report()
    final = report.table("Episode return at the final").set_index("task")["crptpro"]
    assert final["A cheetah_run"] == "600 ± 79 (n = 5) · paper 611 ± 44"
    over = report.table("Over the 2 tasks").set_index("method").loc["crptpro"]
    assert over[["runs", "encoders"]].tolist() == ["10", "5"]
    assert re.fullmatch(r"550 \\\[\d{3}, \d{3}\\\] · paper 562", over["mean score"])
    assert re.fullmatch(r"0.887 \\\[0\.\d{3}, 0\.\d{3}\\\] · paper 0.907", over["mean / DrQ"])
    chance = report.cell("Probability that a run of crptpro", "P(crptpro &gt; other)", "atc")
    assert chance == r"1.00 \[1.00, 1.00\]"
    assert "Brackets are 95% intervals" in report.text
    assert "5: 84%" in report.text


def test_a_partial_reproduction_says_what_is_missing(made: Reproduction) -> None:
    cells = made.runs("crptpro", "walker_run", [500.0])
    begun = made.job("run-begun", "run", done=False)
    (made.root / "jobs" / begun / "log.txt").touch()
    cells += [("crptpro", begun, {"group": "A", "task": "walker_run", "encoder_seed": 0, "seed": 1})]
    cells += [("atc", "run-none", {"group": "A", "task": "walker_run", "encoder_seed": 0, "seed": 0})]
    made.ask("seen", cells)
    made.ask("unseen", [("atc", "run-other", {"group": "A", "task": "finger_spin", "encoder_seed": 0})])
    report = made.report()
    assert "Finished: 1 of 3 results." in report.text
    assert "Missing: crptpro: 1; atc: 1. Missing results are left out, not replaced." in report.text
    assert report.table("2 missing results")["job"].tolist() == ["run-begun", "run-none"]
    states = report.table("run: 2 jobs").set_index("job")["state"]
    assert states.tolist() == ["begun", "finished"]
    assert "Nothing is finished yet: 1 result requested." in report.text
    final = report.cell("Episode return at the final", "crptpro", "A walker_run")
    assert final == "500 (n = 1) · paper 513 ± 33"


def test_a_reproduction_without_any_job_is_reported(made: Reproduction) -> None:
    made.ask("seen", [("atc", "run-none", {"group": "A", "task": "walker_run"})], scale="small")
    assert "Nothing is finished yet: 1 result requested." in made.report().text


def test_methods_are_compared_on_the_tasks_that_all_have(made: Reproduction) -> None:
    cells = made.runs("crptpro", "walker_run", [500.0, 510.0]) + made.runs("crptpro", "cheetah_run", [600.0])
    made.ask("seen", [*cells, *made.runs("atc", "walker_run", [200.0])])
    report = made.report()
    assert "Left out of the comparison of methods: A cheetah_run (no run of atc)." in report.text
    assert report.cell("Over the 1 task", "mean score", "crptpro").startswith("505")


def test_runs_are_compared_on_tasks_too_that_the_paper_has_no_score_of(made: Reproduction) -> None:
    cells = made.runs("crptpro", "walker_walk", [500.0, 510.0])
    made.ask("seen", [*cells, *made.runs("atc", "walker_walk", [505.0])])
    assert made.report().cell("Probability that a run of crptpro", "P(crptpro &gt; other)", "atc") == "0.50"


def test_one_run_against_one_has_no_probability(made: Reproduction) -> None:
    made.ask("seen", made.runs("crptpro", "walker_run", [500.0]) + made.runs("atc", "walker_run", [200.0]))
    assert "Probability that" not in made.report().text


def test_unreadable_records_are_left_out_by_name(made: Reproduction) -> None:
    cells = made.runs("crptpro", "walker_run", [500.0, 510.0, 520.0])
    paths = [made.root / "jobs" / job / "eval.csv" for _, job, _ in cells]
    paths[0].unlink()
    paths[1].write_text(paths[1].read_text().replace(",519.0,", ",nan,").replace(",511.0,", ",,"))
    made.ask("seen", cells)
    report = made.report()
    assert f"{paths[0].parent.name} has no eval.csv" in report.text
    assert "a `episode_return` in it is not a finite number".replace("`", r"\`") in report.text
    assert report.cell("Episode return at the final", "crptpro", "A walker_run").startswith("520 (n = 1)")


def test_colours_and_varied_settings_have_their_own_rows(made: Reproduction) -> None:
    reversed_colors = made.runs("crptpro", "cheetah_run", [400.0], group="C", colors="reversed_background")
    made.ask("colors", reversed_colors)
    cells = []
    for value, score in (("0.05", 300.0), ("0", 200.0)):
        runs = made.runs("crptpro", "walker_run", [score], varied="alpha", value=value)
        cells += [(f"crptpro, alpha {value}", *rest) for _, *rest in runs]
    made.ask("sensitivity", cells)
    report = made.report()
    captions = [caption for caption in report.tables if caption.startswith("Episode return at the final")]
    assert "alpha varied" in captions[1]
    row = report.tables[captions[0]].iloc[0]
    assert row["task"] == "C cheetah_run, reversed_background"
    assert row["crptpro"] == "400 (n = 1) · paper 485 ± 26"
    assert (report.folder / "figures" / "sensitivity-paper-alpha.png").exists()


HOSTILE = "</td><script>alert(1)</script> | [x](javascript:y) $\\frac$ \n# `big` & ünïcode"


def test_hostile_names_break_neither_page(made: Reproduction) -> None:
    job = made.job("run-one", "run", facts={"method": HOSTILE}, eval=evaluations(10.0, method=HOSTILE))
    place = {"group": HOSTILE, "task": HOSTILE, "encoder_seed": 0, "seed": 0}
    made.ask(HOSTILE, [(HOSTILE, job, place), ("other", "run-none", place)], scale="<b>huge</b>")
    report = made.report()
    assert not {"script", "b"} & set(re.findall(r"<(\w+)", report.html))
    assert HOSTILE.replace("\n", "") in html.unescape(report.html).replace("\n", "")
    assert "<script" not in report.text
    assert "[x](javascript" not in report.text
    assert report.cell("Experiments: requested", "finished").startswith("1")
    assert len(list((report.folder / "figures").iterdir())) == 1


def test_the_same_records_give_the_same_files(made: Reproduction) -> None:
    made.ask("seen", made.runs("crptpro", "walker_run", [500.0, 510.0, 520.0, 530.0, 540.0]))
    first = {path.name: path.read_bytes() for path in (made.report().folder / "figures").iterdir()}
    again = {path.name: path.read_bytes() for path in (made.report().folder / "figures").iterdir()}
    assert first == again
    assert len(first) == 1


@pytest.mark.parametrize(("losses", "left"), [
    ((1.02, 1.0, 0.985, 0.9), 300),
    ((0.9, 1.0, 0.995, 0.98), 400),  # what it was before the plateau does not count
    ((1.0, 0.98, 0.995), np.inf),  # back on it
    ((1.0, 1.0), np.inf),
    ((0.8, 0.7), 100),
    ((), np.nan),
])  # fmt: skip
def test_a_plateau_is_left_where_the_loss_stays_below_it(losses: tuple[float, ...], left: float) -> None:
    updates = [100.0 * (n + 1) for n in range(len(losses))]
    record = pd.DataFrame({"updates": updates, "comp": [4.0 * share for share in losses], "ln_num_prototypes": 4.0})
    assert left_plateau(record) == pytest.approx(left, nan_ok=True)


# --- the command, other directories, a browser ----------------------------------------------------------------------


@pytest.mark.parametrize(("name", "reason"), [("nowhere", "There is no directory"), ("", "holds nothing to report on")])
def test_a_directory_without_anything_is_refused_and_left_alone(tmp_path: Path, name: str, reason: str) -> None:
    with pytest.raises(RecordError, match=reason):
        build_report(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_unplanned_runs_are_labelled_by_the_settings_that_differ(tmp_path: Path) -> None:
    for seed, rate in enumerate([1e-3, 1e-3, 1e-4]):
        folder = tmp_path / "mine" / str(seed)
        settings = {"seed": seed, "env_steps": 500_000, "learning_rate": rate, "device": f"cuda:{seed}"}
        settings |= {"cuda_graph": seed == 1, "pretrained": f"crptpro:{seed}"}
        write_json(folder / "config.json", {"config": {"task": "walker_run", **settings}, "versions": {}})
        write_rows(folder / "eval.csv", evaluations(100.0 + seed))
    write_rows(tmp_path / "broken" / "eval.csv", evaluations(1.0))
    report = Report(build_report(tmp_path, out=tmp_path / "page"))
    row = report.table("Episode return at the final").iloc[0]
    assert row["task"] == "walker_run"
    assert row["crptpro (learning_rate 0.001)"] == "100 ± 1 (n = 2)"
    assert row["crptpro (learning_rate 0.0001)"] == "102 (n = 1)"
    assert report.cell("Budgets beside", "here", "downstream runs per encoder") == "1"
    assert "Runs on several encoders count as one method (crptpro (learning_rate 0.001): 2)." in report.text
    assert "This scale does not show" in report.text  # a learning rate is not the paper's
    # What is not known is not there.
    assert list(report.table("run: 3 jobs")) == ["job", "state"]
    assert "h of work" not in report.text
    assert "Machines, as tables" not in report.text


def test_unplanned_runs_on_encoders_of_other_domains_and_without_bonus_are_other_methods(tmp_path: Path) -> None:
    own = {"walker": "crptpro:1", "cheetah, walker": "crptpro:2"}
    for number, (domains, encoder) in enumerate([*own.items(), *own.items()]):
        settings = {"task": "walker_run", "env_steps": 500_000, "pretrained": encoder, "pretrained_on": domains}
        settings |= {"intrinsic_reward_coef": 0.2 if number < 3 else 0}
        write_json(tmp_path / str(number) / "config.json", {"config": settings, "versions": {}})
        write_rows(tmp_path / str(number) / "eval.csv", evaluations(100.0 + number))
    settings |= {"task": "walker_walk", "intrinsic_reward_coef": 0.2}  # alone on its task: nothing differs
    write_json(tmp_path / "walk" / "config.json", {"config": settings, "versions": {}})
    write_rows(tmp_path / "walk" / "eval.csv", evaluations(7.0))
    table = (
        Report(build_report(tmp_path, out=tmp_path / "page")).table("Episode return at the final").set_index("method")
    )
    walker = "crptpro (encoder walker)", "crptpro (encoder cheetah+walker)", "crptpro-no-bonus"
    assert [table.loc[method, "walker_run"] for method in walker] == ["101 ± 1 (n = 2)", "101 (n = 1)", "103 (n = 1)"]
    assert table.loc["crptpro", "walker_walk"] == "7.0 (n = 1)"


def test_a_report_tells_the_encoders_apart_that_ship(tmp_path: Path) -> None:
    table = Report(build_report(RESULTS / "paper_scale" / "finger_spin", out=tmp_path)).table(
        "Episode return at the final"
    )
    names = " ".join(table.astype(str).to_numpy().ravel()) + " ".join(table)
    assert "crptpro (encoder group-a)" in names
    assert "crptpro (encoder all-domains)" in names


def test_every_method_has_a_colour_of_its_own() -> None:
    colors = [style["color"] for style in figures.styles(METHODS).values()]
    assert len(set(colors)) == len(METHODS)


def test_runs_with_the_papers_budgets_are_not_said_to_have_less_and_runs_on_one_encoder_are_not_warned_of(
    tmp_path: Path,
) -> None:
    for seed in range(2):
        settings = {"seed": seed, "env_steps": 500_000, "batch_size": 512, "learning_rate": 1e-4}
        settings |= {"task": "walker_run", "replay_capacity": 40_000, "pretrained": "crptpro:1"}
        write_json(tmp_path / str(seed) / "config.json", {"config": settings, "versions": {}})
        write_rows(tmp_path / str(seed) / "eval.csv", evaluations(100.0 + seed))
    report = Report(build_report(tmp_path, out=tmp_path / "page"))
    assert report.cell("Budgets beside", "here", "downstream batch") == "512"
    assert report.cell("Budgets beside", "here", "downstream runs per encoder") == "2"
    assert "This scale does not show" not in report.text
    assert "Runs on several encoders" not in report.text


def test_unplanned_runs_of_every_method_are_held_against_its_own_budgets_and_show_their_state_and_versions(
    tmp_path: Path,
) -> None:
    budgets = {
        "drq": (1_000_000, 100_000, 1e-3),
        "proto-rl-c": (500_000, 100_000, 1e-4),
        "crptpro": (500_000, 40_000, 1e-4),
    }
    for number, (method, (env_steps, capacity, rate)) in enumerate(budgets.items()):
        settings = {"seed": 0, "env_steps": env_steps, "replay_capacity": capacity, "learning_rate": rate}
        settings |= {"task": "walker_run", "batch_size": 512, "pretrained": method}
        for end in (env_steps, env_steps - 1):  # the second is unfinished
            folder = tmp_path / f"{method} {end}"
            write_json(folder / "config.json", {"config": settings, "versions": {"torch": f"2.1{number}"}})
            rows = evaluations(100.0, method=method)
            write_rows(folder / "eval.csv", [row | {"env_steps": row["env_steps"] * end // 500_000} for row in rows])
    report = Report(build_report(tmp_path, out=tmp_path / "page"))
    assert "This scale does not show" not in report.text
    assert report.cell("Budgets beside", "here", "DrQ's env steps") == "1,000,000"
    assert report.cell("Budgets beside", "here", "replay of DrQ and Proto-RL") == "100,000"
    assert sorted(report.table("run: 6 jobs")["state"]) == ["begun"] * 3 + ["finished"] * 3
    assert sorted(report.table("Versions").iloc[0]) == ["2.10", "2.11", "2.12", "torch"]


def test_long_runs_have_the_mean_of_their_last_ten_evaluations_too(made: Reproduction) -> None:
    cells = made.runs("crptpro", "walker_run", [500.0, 600.0])
    made.ask("seen", cells)
    assert "of the last 10 evaluations" not in made.report().text
    for score, (_, job, _) in zip((500, 600), cells):
        rows = [
            {
                "env_steps": 10_000 * number,
                "episode_return": score + (number if number > 40 else -99),
                "method": "crptpro",
            }
            for number in range(51)
        ]
        write_rows(made.root / "jobs" / job / "eval.csv", rows)
    late = made.report().cell("Episode return, mean of the last 10 evaluations", "crptpro", "A walker_run")
    assert late == "596 ± 71 (n = 2) · paper 513 ± 33"


def test_a_damaged_record_of_embeddings_is_left_out_and_named(made: Reproduction) -> None:
    points = [{"source": "walker random", "pc1": 0.0, "pc2": 1.0, "pc3": 2.0}] * 3
    job = made.job("embeddings-1", "embeddings", embeddings=points)
    made.ask("visualize", [("proto-rl-s", job, {"group": "B", "encoder_seed": 0})])
    text = made.report().text
    assert re.search(r"Left out: .*explained\.json cannot be read", text)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[pd.DataFrame]:
    """The points of every figure."""
    found: list[pd.DataFrame] = []
    monkeypatch.setattr("crptpro.experiments.report.draw", lambda points, *_, **__: found.append(points) or Figure())
    return found


@pytest.mark.parametrize(("columns", "panels"), [
    ({"comp": 4.0, "embedding_cosine": 0.5}, ["comparative loss [nats]", "mean pairwise cosine"]),  # no prototypes
    ({"embedding_cosine": 0.5, "prototypes_in_use": 3.0, "prototype_ane": 0.1}, ["mean pairwise cosine"]),
    ({"loss_mine": 1.0}, []),
])  # fmt: skip
def test_diagnostics_show_what_a_loss_of_ones_own_records(
    made: Reproduction, drawn: list[pd.DataFrame], columns: dict[str, float], panels: list[str]
) -> None:
    job = made.job("encoder-1", "encoder", pretrain=[{"updates": n, **columns} for n in (100, 200)])
    made.ask("stability", [("mine", job, {"group": "A", "encoder_seed": 0})])
    assert made.report().cell(ENDS, "updates", "mine") == "200"
    assert [panel for points in drawn for panel in points["panel"].unique()] == panels


def test_a_curve_is_interpolated_where_runs_evaluate_at_other_env_steps(
    made: Reproduction, drawn: list[pd.DataFrame]
) -> None:
    cells = made.runs("crptpro", "walker_run", [500, 500])
    for seed, (_, job, _) in enumerate(cells):
        points = [0, 100_000, 200_000 + 30_000 * seed, 500_000]
        rows = [{"env_steps": n, "episode_return": n / 1000 + seed, "method": "crptpro"} for n in points]
        write_rows(made.root / "jobs" / job / "eval.csv", rows[seed:])  # the second is not evaluated at 0
    made.ask("seen", cells)
    made.report()
    [curves] = [points for points in drawn if "line" in points]
    mean = curves[curves["line"] == "mean"]
    assert mean["x"].tolist() == [100_000, 200_000, 230_000, 500_000]
    assert mean["y"].tolist() == pytest.approx([100.5, 200.5, 230.5, 500.5])


def test_runs_without_a_common_span_and_probes_without_a_finite_number_are_left_out(made: Reproduction) -> None:
    cells = made.runs("crptpro", "walker_run", [500, 500])
    for (_, job, _), n in zip(cells, (0, 10_000), strict=True):
        write_rows(
            made.root / "jobs" / job / "eval.csv", [{"env_steps": n, "episode_return": 1.0, "method": "crptpro"}]
        )
    made.ask("seen", cells)
    about = {"domain": "mine", "colors": "normal", "seen": "no", "embedding": "features", "coordinate": "",
             "samples": 10, "held_out_episodes": 1}  # fmt: skip
    scores = {"r2_position": math.nan, "r2_velocity": 0.5, "effective_rank": 3.0, "mean_cosine": 0.1}
    facts = {"method": "random-encoder"}
    probe = made.job(
        "probe-1", "probe", facts=facts, probe=[{**about, "measure": m, "value": v} for m, v in scores.items()]
    )
    made.ask("probe", [("random-encoder", probe, {"group": "A", "encoder_seed": 0})])
    report = made.report()
    assert "R2 of positions" not in report.text
    assert report.cell("R2 of velocities", "mine", "random-encoder").startswith("0.500")


BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


@pytest.mark.parametrize("width", [1200, 400])
def test_a_browser_shows_the_page_and_it_never_scrolls_sideways(seen: Report, tmp_path: Path, width: int) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser was found ({', '.join(BROWSERS)})")
    page = seen.folder / f"measured-{width}.html"
    script = "<script>document.title = 'said ' + (document.documentElement.scrollWidth <= innerWidth) + ' ' + " \
        "[...document.images].filter(i => i.naturalWidth > 100).length</script></body>"  # fmt: skip
    page.write_text(seen.html.replace("</body>", script))
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
        "--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=5000", f"--user-data-dir={tmp_path}",
        f"--window-size={width},1400", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    assert f"<title>said true {seen.html.count('<img')}</title>" in done.stdout

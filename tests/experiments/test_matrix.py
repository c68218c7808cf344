"""What each experiment asks for: which cells, which jobs, which settings."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import crptpro.objectives.methods as registry
from crptpro import plugins
from crptpro.domains import GROUPS
from crptpro.experiments import matrix
from crptpro.experiments.jobs import FRAME_BYTES, KINDS, Job, bytes_of, is_finished, make_plan
from crptpro.experiments.matrix import EXPERIMENTS, METHODS, PAPER, SMALL, TINY, Cell, Request
from crptpro.objectives import Exploration, ProtoLoss, register_method

RESULTS = Path(__file__).parents[2] / "results"
PART = {"groups": ("A",), "tasks": ("walker_run",)}


def cells(experiment: str, scale: Any = SMALL, **part: Any) -> list[Cell]:
    return EXPERIMENTS[experiment].cells(Request(scale, **part))


def option(job: Job, name: str) -> str | None:
    """The word after an option of a job's command."""
    return job.command[job.command.index(name) + 1] if name in job.command else None


def of(found: list[Cell], label: str, **place: Any) -> list[Job]:
    return [c.job for c in found if c.label == label and place.items() <= dict(c.place).items()]


@pytest.mark.parametrize(("experiment", "count", "kinds"), [
    ("seen", 12 * 13 * 3, {"run"}),
    ("unseen", 10 * 7 * 3, {"run"}),
    ("colors", 3 * 7 * 3, {"run"}),
    ("finetune", 5 * 6 * 3, {"run"}),
    # Two groups of three tasks; three methods with prototypes of a group, two of them twice; (S) twice on two tasks.
    ("ablation", (6 * 5 + 2 * 2) * 3, {"run"}),
    # Five weights of two methods, three sizes of datasets.
    ("sensitivity", 3 * (5 * 2 + 3) * 3, {"run"}),
    ("efficiency", 8 * 3, {"timing"}),
    ("prototypes", 2 + 1 + 2 + 2, {"encoder", "explored"}),
    ("coverage", 1, {"coverage"}),
    ("stability", 2 + 1 + 1, {"encoder", "explored"}),
    ("visualize", 2, {"embeddings"}),
    ("probe", 9 * 5, {"probe"}),
])  # fmt: skip
def test_every_experiment_of_the_paper_has_its_cells(experiment: str, count: int, kinds: set[str]) -> None:
    found = cells(experiment, PAPER)
    assert len(found) == count
    assert {cell.job.kind for cell in found} == kinds
    places = Counter((cell.label, tuple(sorted(cell.place.items()))) for cell in found)
    assert max(places.values()) == 1  # no number stands in two jobs


def test_the_committed_records_are_those_of_the_same_commands() -> None:
    paths = list((RESULTS / "seen_small" / "experiments").glob("*.json"))
    assert len(paths) == 7
    for path in paths:
        name = path.stem.removesuffix("-small")
        tasks = {"tasks": ("walker_run",)} if name in ("seen", "prototypes") else {}
        asked = cells(name, SMALL, threads=2, groups=("A",), **tasks)
        missing = {cell.label for cell in asked if not is_finished(RESULTS / "seen_small", cell.job)}
        # Controls that have not been run yet.
        assert missing <= {"crptpro-no-bonus", "random-encoder-standardised"}


def test_every_system_of_seen_has_its_own_encoder_and_settings() -> None:
    found = cells("seen", SMALL, **PART)
    assert list(dict.fromkeys(cell.label for cell in found)) == list(METHODS)
    jobs = {label: of(found, label, seed=0)[0] for label in METHODS}
    needs = {label: [(n.kind, *n.facts.get("domains", ())) for n in job.needs] for label, job in jobs.items()}
    group = GROUPS["A"]
    assert needs == {
        **{label: [("encoder", *group)] for label in ("crptpro", "crptpro-fast", "crptpro-no-bonus", "atc")},
        **{label: [("explored", *group)] for label in ("proto-rl-c", "apt-c", "becl")},
        **{label: [("explored", "walker")] for label in ("proto-rl-s", "apt-s")},
        **{label: [("untrained",)] for label in ("random-encoder", "random-encoder-standardised")},
        "crptpro-finetune": [("finetuned", "walker")],
        "drq": [],
    }
    standardised = jobs["random-encoder-standardised"].needs[0]
    assert [needed.facts["domain"] for needed in standardised.needs] == list(group)
    assert jobs["crptpro-no-bonus"].needs == jobs["crptpro"].needs
    without = {label: option(job, "--intrinsic-reward-coef") for label, job in jobs.items()}
    assert without == {**dict.fromkeys(jobs), "crptpro-no-bonus": "0"}


def test_all_systems_have_as_many_runs_and_no_two_runs_are_the_same() -> None:
    found = cells("seen", SMALL, encoder_seeds=(0, 1), seeds=(3, 4), **PART)
    counts = Counter(cell.label for cell in found)
    assert set(counts.values()) == {4}
    assert len({cell.job.key for cell in found}) == len(found)
    # DrQ has no encoder to share; a run is the same whatever else is asked for.
    [one] = of(cells("seen", SMALL, encoder_seeds=(1,), seeds=(4,), **PART), "drq")
    assert one in of(found, "drq")
    # Runs of one seed on two tasks have nothing in common.
    tasks = of(cells("seen", SMALL, groups=("A",), seeds=(0,)), "drq")
    assert len({option(job, "--seed") for job in tasks}) == len(tasks) == 3


def test_a_repeated_name_is_planned_once() -> None:
    once = {"groups": ("A",), "tasks": ("walker_run",), "methods": ("crptpro",)}
    for experiment in ("probe", "efficiency", "seen"):
        assert cells(experiment, **{name: each * 2 for name, each in once.items()}) == cells(experiment, **once)


def test_experiments_share_what_they_have_in_common() -> None:
    seen = {cell.job for cell in cells("seen", SMALL, **PART)}
    assert {cell.job for cell in cells("finetune", SMALL, **PART)} <= seen
    assert {cell.job for cell in cells("ablation", SMALL, **PART)} & seen
    # The usual weight and the usual size of the datasets are CRPTpro.
    found = cells("sensitivity", SMALL, **PART)
    usual = [*of(found, "crptpro, alpha 0.005"), *of(found, "crptpro, b 20,000")]
    assert set(usual) == set(of(cells("seen", SMALL, **PART), "crptpro"))
    assert {c.place["value"] for c in found if c.place["varied"] == "b"} == {"5000", "20000"}


def test_the_ablation_has_the_papers_weights_and_budgets() -> None:
    found = cells("ablation", PAPER)
    single = [(c.label, c.job.needs[0].facts) for c in found if c.label.startswith("proto-rl-s")]
    weights = {(label, *facts["domains"]): (facts["loss"], facts["explore"]) for label, facts in single}
    short = {"env_steps": 200_000}
    assert weights == {
        ("proto-rl-s", "cheetah"): ({}, short), ("proto-rl-s", "hopper"): ({}, short),
        ("proto-rl-s with dispersion", "cheetah"): ({"intr_loss_coef": 1e-3}, short),
        ("proto-rl-s with dispersion", "hopper"): ({"intr_loss_coef": 5e-4}, short),
    }  # fmt: skip
    without = of(found, "crptpro without dispersion")[0].needs[0]
    assert option(without, "--loss") == "intr_loss_coef=0.0"
    assert of(found, "proto-rl-c with dispersion")[0].needs[0].facts["loss"] == {"intr_loss_coef": 5e-3}
    measured = {cell.job for cell in cells("prototypes", PAPER, groups=("A", "C"))}
    assert measured <= {needed for cell in found for needed in cell.job.needs}


def test_other_colours_are_drawn_downstream() -> None:
    drawn = {(option(cell.job, "--colors"), cell.place["colors"]) for cell in cells("colors", SMALL)}
    assert drawn == {("reversed_background", "reversed_background")}


def test_timings_count_every_encoder_of_a_single_domain_method_and_need_only_data() -> None:
    found = cells("efficiency", SMALL, groups=("A",), threads=2)
    single, several = (of(found, method, domains=3)[0] for method in ("proto-rl-s", "crptpro"))
    assert single.command.count("--training") == 3
    assert several.command.count("--training") == 1
    assert {needed.kind for needed in several.needs} == {"dataset"}
    assert single.needs == ()
    assert all(cell.job.is_exclusive for cell in found)
    # Device and threads are a part of what is measured, and of nothing else.
    assert several not in [c.job for c in cells("efficiency", SMALL, groups=("A",), threads=1)]
    assert cells("seen", SMALL, threads=1) == cells("seen", SMALL, threads=2)


def test_an_explorers_replay_is_read_from_the_directory_that_its_domains_name_becomes() -> None:
    name = "gymnasium:HalfCheetah-v5"
    explorer = matrix.encoder(SMALL, "apt-c", [name], 0)
    job = matrix.comparison("coverage", explorer, explorer, [], samples=1, seed=0)
    assert option(job, "--replays") == f"{{{explorer.key}}}/replay/gymnasium-HalfCheetah-v5"


def test_a_tiny_reproduction_needs_few_jobs_of_every_kind() -> None:
    jobs = make_plan([c.job for name in EXPERIMENTS for c in cells(name, TINY)], Path("nowhere")).jobs
    assert len({job.key for job in jobs}) == len(jobs) < 800
    assert {job.kind for job in jobs} == set(KINDS)
    place = {job.key: index for index, job in enumerate(jobs)}
    assert all(place[needed.key] < place[job.key] for job in jobs for needed in job.needs)


def test_a_users_method_takes_the_scale_of_its_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plugin = tmp_path / "mine.py"
    plugin.write_text("# first")
    monkeypatch.setattr(plugins, "_loaded", [str(plugin)])
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    usual = of(cells("seen", TINY, methods=("crptpro",), **PART), "crptpro")[0].needs[0]
    register_method("mine", ProtoLoss, loss_options={"tau": 0.2}, updates=300, is_preset=True)
    [mine] = [c.job.needs[0] for c in cells("seen", TINY, methods=("mine",), **PART)]
    assert mine.facts["loss"] == usual.facts["loss"]
    assert (mine.facts["updates"], mine.facts["batch_size"]) == (6, 4)
    assert cells("seen", PAPER, methods=("mine",), **PART)[0].job.needs[0].facts["updates"] == 300
    # An edited plugin makes another encoder, and leaves those of the library alone.
    plugin.write_text("# second")
    assert cells("seen", TINY, methods=("mine",), **PART)[0].job.needs[0].key != mine.key
    assert cells("seen", TINY, methods=("crptpro",), **PART)[0].job.needs[0].key == usual.key


def test_a_users_method_is_planned_with_its_own_budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    own = {"replay_capacity": 1_000_000, "env_steps": 2_000_000}
    register_method("mine", ProtoLoss, is_preset=True, downstream=own, exploration=Exploration(replay_capacity=5_000))
    [job] = [c.job for c in cells("seen", PAPER, methods=("mine",), seeds=(0,), **PART)]
    assert job.facts["env_steps"] == 2_000_000
    assert bytes_of(job)[1] > 1_000_000 * FRAME_BYTES
    frames, *_ = (bytes_of(needed)[0] / FRAME_BYTES for needed in job.needs)
    assert 3 * 5_000 < frames < 3 * 14_000  # with those of checkpoints, and the encoder
    # Where the scale has a number, it is the scale's.
    [job] = [c.job for c in cells("seen", SMALL, methods=("mine",), seeds=(0,), **PART)]
    assert (job.facts["env_steps"], job.facts["replay_capacity"]) == (20_000, 12_000)

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from toy_world import ToyEnv, fixed_length

from crptpro.cards import write_json
from crptpro.data.collect_worker import EpisodeRoller
from crptpro.data.collection import DomainCollection
from crptpro.errors import RecordError
from crptpro.experiments.building import JobSettings, build
from crptpro.experiments.goals import RANDOM_ENCODER, Goal, Request
from crptpro.experiments.measurements import ProbePiece
from crptpro.experiments.pieces import (
    DatasetPiece,
    PretrainedPiece,
    RunPiece,
    UntrainedPiece,
    piece_from_json,
)
from crptpro.experiments.plan import make_plan
from crptpro.experiments.scales import PAPER, SMALL, TINY
from crptpro.experiments.store import DONE, Store
from crptpro.experiments.study import factors, factors_of, finalists, study, temperatures
from crptpro.pretrained import load_pretrained


def of(goals: list[Goal], kind: type) -> list[Goal]:
    return [goal for goal in goals if isinstance(goal.piece, kind)]


def pieces(goals: list[Goal], kind: type) -> set:
    return {goal.piece for goal in goals if isinstance(goal.piece, kind)}


def effective(piece: PretrainedPiece) -> dict:
    """Every number that is varied, defaults included."""
    usual = {
        "num_prototypes": 512, "hidden_dim": 1024, "intr_loss_coef": 5e-3, "batch_size": 512,
        "learning_rate": 1e-4, "encoder_tau": 0.05, "warmup_updates": 0, "pixel_offset": 0.0,
    }  # fmt: skip
    return {**usual, **dict(piece.training), **dict(piece.loss), **dict(piece.encoder)}


@pytest.fixture(scope="module")
def small() -> list[Goal]:
    return study(Request(SMALL))


def test_temperatures_are_compared_on_two_groups_and_two_seeds(small: list[Goal]) -> None:
    goals = temperatures(Request(SMALL))
    encoders = pieces(goals, PretrainedPiece)
    assert len(encoders) == 3 * 2 * 2
    assert {piece.updates for piece in encoders} == {10_000}
    assert {piece.snapshots for piece in encoders} == {(500, 1_000, 2_000, 3_000, 5_000)}
    assert {dict(piece.training)["batch_size"] for piece in encoders} == {128}
    assert {effective(piece)["num_prototypes"] for piece in encoders} == {512}
    names = ("assignment_temperature", "annealing_updates")
    assert Counter(tuple(dict(piece.loss).get(name) for name in names) for piece in encoders) == {
        (None, None): 4,
        (0.05, None): 4,
        (0.05, 10_000): 4,
    }
    places = Counter((dict(g.place)["group"], dict(g.place)["value"]) for g in of(goals, PretrainedPiece))
    assert set(places.values()) == {2}
    assert {key[0] for key in places} == {"A", "C"}


def test_each_is_probed_along_its_training_on_its_domains_and_one_more() -> None:
    goals = of(temperatures(Request(SMALL, groups=("A",))), ProbePiece)
    one = [g for g in goals if dict(g.place)["value"] == "0.05" and dict(g.place)["encoder_seed"] == 0]
    domains = ("cheetah", "walker", "quadruped", "finger")
    expected = Counter(
        (done, domain) for done in (500, 1_000, 2_000, 3_000, 5_000, 10_000) for domain in domains
    )
    assert Counter((dict(g.place)["updates"], dict(g.place)["domain"]) for g in one) == expected
    for goal in one:
        at = None if (done := dict(goal.place)["updates"]) == 10_000 else done
        assert goal.piece.at_updates == at
        assert goal.piece.colors == "normal"
    control = [g for g in goals if g.label == RANDOM_ENCODER]
    assert {g.piece.encoder for g in control} == {UntrainedPiece(RANDOM_ENCODER, seed) for seed in (0, 1)}


def test_the_finished_temperatures_learn_a_task_of_each_group() -> None:
    goals = of(temperatures(Request(SMALL)), RunPiece)
    assert Counter(goal.piece.task for goal in goals) == {"walker_run": 6, "finger_spin": 6}
    assert {goal.piece.seed for goal in goals} == {0}
    assert {goal.piece.encoder.updates for goal in goals} == {10_000}
    only = Request(SMALL, tasks=("walker_run",), seeds=(0, 1), encoder_seeds=(4, 7))
    goals = of(temperatures(only), RunPiece)
    assert Counter(goal.piece.task for goal in goals) == {"walker_run": 3 * 2 * 2}
    assert {goal.piece.encoder.seed for goal in goals} == {4, 7}


def test_a_factor_changes_one_number_and_all_share_the_baseline() -> None:
    goals = of(factors(Request(SMALL)), PretrainedPiece)
    options = factors_of(SMALL)
    assert Counter(dict(g.place)["factor"] for g in goals) == {f.name: len(f.values) for f in options}
    assert {f.name: f.values for f in options} == {
        "num_prototypes": (128, 256, 512, 1024),
        "batch_size": (64, 128, 256),
        "hidden_dim": (512, 1024, 2048),
        "pixel_offset": (0.0, 0.5),
        "encoder_tau": (0.01, 0.05, 0.2),
        "learning_rate": (5e-5, 1e-4, 3e-4),
        "warmup_updates": (0, 500),
        "intr_loss_coef": (0.0, 5e-3, 0.5, 50.0),
    }
    usual = [g.piece for g in goals if any(dict(g.place)["value"] == f"{f.usual:g}"
             for f in options if f.name == dict(g.place)["factor"])]  # fmt: skip
    assert len(usual) == len(options)
    (baseline,) = set(usual)
    assert (baseline.updates, baseline.seed, baseline.snapshots) == (3_000, 0, (1_000,))
    assert len({g.piece for g in goals}) == 1 + sum(len(f.values) - 1 for f in options) == 17
    for goal in goals:
        name, value = dict(goal.place)["factor"], dict(goal.place)["value"]
        expected = {**effective(baseline), name: float(value)}
        assert effective(goal.piece) == expected
        assert (goal.piece == baseline) == (expected == effective(baseline))
        assert (goal.piece.updates, goal.piece.datasets) == (baseline.updates, baseline.datasets)


def test_finalists_are_full_length_trials_of_both_learning_rates_at_both_temperatures() -> None:
    goals = finalists(Request(SMALL))
    encoders = of(goals, PretrainedPiece)
    found = {
        dict(g.place)["value"]: (
            effective(g.piece)["learning_rate"],
            dict(g.piece.loss).get("assignment_temperature", 0.1),
        )
        for g in encoders
    }
    assert found == {
        "1e-4 and 0.1": (1e-4, 0.1),
        "1e-4 and 0.05": (1e-4, 0.05),
        "3e-4 and 0.05": (3e-4, 0.05),
        "3e-4 and 0.1": (3e-4, 0.1),
    }
    assert {dict(g.place)["usual"] for g in encoders} == {"1e-4 and 0.1"}
    assert len(pieces(goals, PretrainedPiece)) == len(pieces(goals, RunPiece)) == 4 * 2 * 2
    slow = {g.piece for g in encoders if dict(g.place)["value"].startswith("1e-4")}
    assert slow < pieces(temperatures(Request(SMALL)), PretrainedPiece)  # made once for both
    for group in "AC":
        plain = [
            g.piece for g in encoders if dict(g.place) == {**dict(g.place), "group": group, "encoder_seed": 0}
        ]
        assert len({(p.updates, p.snapshots, p.datasets) for p in plain}) == 1


def test_nothing_is_asked_for_twice(small: list[Goal]) -> None:
    assert len(small) == len(set(small))
    assert len(pieces(small, PretrainedPiece)) == 12 + 8 + 17
    assert len(pieces(small, RunPiece)) == 12 + 8
    # At 6 points of each full-length encoder and 2 of each factor's on 4 domains; 2 untrained ones on the 6 of both
    # groups.
    assert len(pieces(small, ProbePiece)) == ((12 + 8) * 6 + 17 * 2) * 4 + 2 * 6


def test_the_papers_scale_has_its_batch_and_updates() -> None:
    goals = study(Request(PAPER))
    usual = [p for p in pieces(goals, PretrainedPiece) if not p.training and not p.loss and not p.encoder]
    assert {piece.updates for piece in usual} == {50_000}
    assert {f.name: f.usual for f in factors_of(PAPER)}["batch_size"] == 512


def test_descriptions_come_back_and_older_ones_keep_their_names(small: list[Goal]) -> None:
    for piece in {goal.piece for goal in small}:
        again = piece_from_json(json.loads(json.dumps(piece.to_json())))
        assert again == piece
        assert again.key == piece.key
    plain = PretrainedPiece("crptpro", 0, datasets=(DatasetPiece("walker", 10, 0),), updates=3)
    assert set(plain.to_json()) == {"kind", "method", "seed", "datasets", "updates"}
    probe = ProbePiece(plain, plain.datasets[0])
    assert set(probe.to_json()) == {"kind", "encoder", "dataset"}
    assert replace(probe, at_updates=2).title == "crptpro seed 0 at 2 on walker"


def test_other_methods_are_not_studied() -> None:
    assert study(Request(SMALL, methods=("atc",))) == []
    assert all(goal.label.startswith("crptpro") for goal in study(Request(SMALL, methods=("crptpro",))))


def toy_dataset(path: Path) -> None:
    settings = {"image_size": 84, "action_repeat": 2, "camera": 0, "quality": "exact"}
    request = {"domain": path.name, "task": f"{path.name}_go", "seed": 0, "transitions": 27, **settings}
    collection = DomainCollection(path, request, 10)
    roller = EpisodeRoller(lambda: ToyEnv(fixed_length, image_size=84))
    while (job := collection.next_job()) is not None:
        collection.accept(job.episode, roller.roll(job))
    roller.close()
    collection.close()


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """With the datasets of group A, seed 0, as if collected."""
    store = Store(tmp_path)
    for piece in pieces(factors(Request(TINY)), PretrainedPiece).pop().datasets:
        toy_dataset(store.dataset(piece))
        write_json(store.path(piece) / DONE, {"seconds": 0.0})
    return store


def test_tiny_encoders_are_made_and_found_at_every_point_that_is_probed(store: Store) -> None:
    goals = study(Request(TINY, groups=("A",)))
    (annealed,) = (g.piece for g in goals if isinstance(g.piece, PretrainedPiece) and g.piece.seed == 0
                   and dict(g.place)["value"] == "annealed")  # fmt: skip
    (shifted,) = {g.piece for g in goals if isinstance(g.piece, PretrainedPiece) and g.piece.encoder}
    for piece in (annealed, shifted):
        build(piece, store, JobSettings())
        assert store.is_done(piece)
        probed = {g.piece.at_updates for g in of(goals, ProbePiece) if g.piece.encoder == piece}
        assert probed == {3, None}
        loaded = {at: load_pretrained(store.encoder(piece, at)) for at in probed}
        assert [loaded[at].card["training"]["updates"] for at in (3, None)] == [3, 6]
    assert loaded[3].encoder.pixel_offset == loaded[None].encoder.pixel_offset == 0.5
    config = load_pretrained(store.encoder(annealed)).card["loss"]["config"]
    assert (config["assignment_temperature"], config["annealing_updates"]) == (0.05, 6)
    assert make_plan([annealed], store).missing == ()
    with pytest.raises(RecordError, match="not finished"):
        build(next(g.piece for g in of(goals, RunPiece)), store, JobSettings())

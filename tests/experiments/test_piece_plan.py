from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from crptpro.cards import write_json
from crptpro.experiments.goals import Request, dataset, encoder, encoder_for_task, run
from crptpro.experiments.matrix import seen
from crptpro.experiments.measurements import CoveragePiece
from crptpro.experiments.pieces import ExploredPiece, Piece
from crptpro.experiments.plan import make_plan
from crptpro.experiments.scales import TINY
from crptpro.experiments.store import DONE, Store

A = ("cheetah", "walker", "quadruped")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def finish(piece: Piece, store: Store) -> None:
    record(piece, store)
    for path in store.outputs(piece):
        path.parent.mkdir(parents=True)
        path.touch()


def record(piece: Piece, store: Store) -> None:
    write_json(store.path(piece) / DONE, {"seconds": 1.0})


def finetuned_run() -> Piece:
    return run(TINY, "walker_run", encoder_for_task(TINY, "crptpro-finetune", A, "walker_run", 0), 0)


def test_every_piece_comes_once_and_after_all_that_it_needs(store: Store) -> None:
    goals = [goal.piece for goal in seen(Request(TINY))]
    plan = make_plan([*goals, *goals], store)
    assert len(set(plan.pieces)) == len(plan.pieces)
    for place, piece in enumerate(plan.pieces):
        assert set(piece.needs) <= set(plan.pieces[:place])
    assert set(goals) <= set(plan.pieces)
    assert plan.missing == plan.pieces


def test_the_order_is_that_in_which_things_can_be_made(store: Store) -> None:
    kinds = [piece.kind for piece in make_plan([finetuned_run()], store).pieces]
    assert kinds == ["dataset", "dataset", "dataset", "encoder", "finetuned", "run"]


def test_nobody_asks_for_what_only_a_finished_piece_needed(store: Store) -> None:
    goal = finetuned_run()
    finish(goal.encoder, store)  # type: ignore[attr-defined]
    plan = make_plan([goal], store)
    assert [piece.kind for piece in plan.pieces] == ["finetuned", "run"]
    assert plan.missing == (goal,)
    finish(goal, store)
    assert make_plan([goal], store).missing == ()
    assert make_plan([goal], store).pieces == (goal,)


def test_what_an_unfinished_piece_needs_is_asked_for_even_if_a_finished_one_needed_it_too(
    store: Store,
) -> None:
    goal = finetuned_run()
    base = goal.encoder.base  # type: ignore[attr-defined]
    finish(base, store)
    missing = make_plan([goal], store).missing
    assert [piece.key for piece in missing if piece.kind == "dataset"] == [goal.encoder.dataset.key]  # type: ignore[attr-defined]


def test_of_a_finished_goal_the_records_are_enough(store: Store) -> None:
    goal = finetuned_run()
    record(goal.encoder, store)  # type: ignore[attr-defined]
    record(goal, store)
    assert make_plan([goal.encoder, goal], store).missing == ()  # type: ignore[attr-defined]


@pytest.mark.parametrize("is_goal_too", [True, False])
def test_what_an_unfinished_piece_reads_is_made_again_where_only_its_records_were_kept(
    store: Store, is_goal_too: bool
) -> None:
    goal = finetuned_run()
    encoder = goal.encoder  # type: ignore[attr-defined]
    record(encoder, store)
    record(encoder.base, store)
    finish(encoder.dataset, store)
    goals = [encoder, goal] if is_goal_too else [goal]
    plan = make_plan(goals, store)
    assert [piece.kind for piece in plan.missing] == ["dataset", "dataset", "encoder", "finetuned", "run"]
    for place, piece in enumerate(plan.pieces):
        assert piece.key in plan.done or set(piece.needs) <= set(plan.pieces[:place])
    (store.encoder(encoder) / "weights.safetensors").parent.mkdir()
    assert goal.encoder in make_plan(goals, store).missing  # its card alone is a record  # type: ignore[attr-defined]
    (store.encoder(encoder) / "weights.safetensors").touch()
    assert make_plan(goals, store).missing == (goal,)


def test_an_encoder_whose_snapshots_were_removed_is_made_again(store: Store) -> None:
    base = finetuned_run().encoder.base  # type: ignore[attr-defined]
    kept = replace(base, snapshots=(2,))
    finish(kept, store)
    assert store.is_done(kept)
    shutil.rmtree(store.encoder(kept, 2))
    assert not store.is_done(kept)
    assert store.is_recorded(kept)


def test_an_explorer_whose_replays_were_removed_explores_again_for_those_that_read_them(store: Store) -> None:
    explorer = encoder(TINY, "proto-rl-c", A, 0)
    judge = encoder(TINY, "crptpro", A, 0)
    data = tuple(dataset(TINY, domain, 0) for domain in A)
    for piece in (explorer, judge, *data):
        finish(piece, store)
    assert isinstance(explorer, ExploredPiece)
    reader, learner = CoveragePiece(explorer, data, judge), run(TINY, "walker_run", explorer, 0)
    assert make_plan([learner], store).missing == (learner,)
    assert make_plan([learner, reader], store).missing == (learner, explorer, reader)
    for domain in A:
        (store.path(explorer) / "replay" / domain).mkdir(parents=True)
    assert make_plan([learner, reader], store).missing == (learner, reader)

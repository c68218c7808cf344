from __future__ import annotations

from pathlib import Path

import pytest

from crptpro.cards import write_json
from crptpro.experiments.building import DONE, Store
from crptpro.experiments.goals import Request, encoder_for_task, run
from crptpro.experiments.matrix import seen
from crptpro.experiments.pieces import Piece
from crptpro.experiments.plan import make_plan
from crptpro.experiments.scales import TINY

A = ("cheetah", "walker", "quadruped")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def finish(piece: Piece, store: Store) -> None:
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

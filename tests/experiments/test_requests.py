"""What was asked of a reproduction is written down, and nothing of it is lost."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from crptpro.errors import RecordError
from crptpro.experiments.goals import Goal, Request
from crptpro.experiments.matrix import seen
from crptpro.experiments.requests import AskedGoal, read_request, request_path, write_request
from crptpro.experiments.scales import TINY
from crptpro.experiments.store import Store


def ask(store: Store, **part: object) -> list[Goal]:
    request = Request(TINY, groups=("A",), tasks=("walker_run",), **part)  # type: ignore[arg-type]
    goals = seen(request)
    write_request(store, "seen", request, goals)
    return goals


def described(goal: AskedGoal, store: Store) -> Goal:
    return Goal(goal.label, store.described(goal.key), goal.place)


def test_goals_are_read_back_with_their_pieces(tmp_path: Path) -> None:
    store = Store(tmp_path)
    goals = ask(store, methods=("crptpro", "drq"), seeds=(0, 1))
    asked = read_request(request_path(tmp_path, "seen", "tiny"))
    assert (asked.experiment, asked.scale) == ("seen", "tiny")
    assert [described(goal, store) for goal in asked.goals] == goals
    assert asked.request == {
        "methods": ["crptpro", "drq"], "groups": ["A"], "tasks": ["walker_run"], "encoder_seeds": [0], "seeds": [0, 1],
        "colors": "reversed_background", "device": "cpu", "threads": 1,
    }  # fmt: skip


def test_what_was_asked_for_before_is_kept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    before = ask(store, methods=("crptpro", "drq"))
    after = ask(store, methods=("drq", "atc"))
    asked = read_request(request_path(tmp_path, "seen", "tiny"))
    crptpro = [goal for goal in before if goal.label == "crptpro"]
    assert [described(goal, store) for goal in asked.goals] == [*after, *crptpro]
    assert asked.request["methods"] == ["drq", "atc"]
    assert [path.name for path in (tmp_path / "experiments").glob("*.json")] == ["seen-tiny.json"]


def test_a_method_that_changed_takes_the_place_of_what_it_was(tmp_path: Path) -> None:
    store, request = Store(tmp_path), Request(TINY, groups=("A",), tasks=("walker_run",))
    first, second, *others = seen(request)
    write_request(store, "seen", request, [first, second, *others])
    changed = replace(first, piece=second.piece)
    asked = write_request(store, "seen", request, [changed])
    assert [described(goal, store) for goal in asked.goals] == [changed, second, *others]


def test_two_commands_that_ask_at_the_same_time_lose_nothing(tmp_path: Path) -> None:
    store, request = Store(tmp_path), Request(TINY, groups=("A",), tasks=("walker_run",))
    goals = seen(request)
    with ThreadPoolExecutor() as several:
        list(several.map(lambda goal: write_request(store, "seen", request, [goal]), goals))
    asked = read_request(request_path(tmp_path, "seen", "tiny"))
    assert {described(goal, store) for goal in asked.goals} == set(goals)


def test_asking_again_changes_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ask(store)
    first = request_path(tmp_path, "seen", "tiny").read_text()
    ask(store)
    assert request_path(tmp_path, "seen", "tiny").read_text() == first


def test_a_place_with_several_values_is_read_back(tmp_path: Path) -> None:
    store = Store(tmp_path)
    request = Request(TINY)
    goal = Goal("x", seen(request)[0].piece, (("domains", ("walker", "hopper")), ("seed", 0)))
    write_request(store, "probe", request, [goal])
    assert [
        described(asked, store) for asked in read_request(request_path(tmp_path, "probe", "tiny")).goals
    ] == [goal]


@pytest.mark.parametrize(
    "content",
    [
        {"experiment": "seen"},
        {"goals": ["x"]},
        {"goals": [{"label": "x", "key": "y", "place": None}]},
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path: Path, content: dict[str, object]) -> None:
    path = request_path(tmp_path, "seen", "tiny")
    path.parent.mkdir()
    path.write_text(json.dumps(content))
    with pytest.raises(RecordError, match=r"seen-tiny\.json does not say what was asked for"):
        ask(Store(tmp_path))

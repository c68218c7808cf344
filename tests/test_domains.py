from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from crptpro import domains
from crptpro.domains import PAPER_DOMAINS, Domain, expand_groups, get_domain, register_domain
from crptpro.errors import CRPTproError, UnknownNameError


def make_nothing(seed: int) -> None: ...


@pytest.fixture(autouse=True)
def _empty_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domains, "_registered", {})


@pytest.mark.parametrize(("name", "domain", "task"), [
    ("cheetah", "cheetah", "cheetah_run"),
    ("walker", "walker", "walker_run"),
    ("quadruped", "quadruped", "quadruped_run"),
    ("cartpole", "cartpole", "cartpole_swingup_sparse"),
    ("pendulum", "pendulum", "pendulum_swingup"),
    ("manipulation", "manipulation", "reach_duplo"),
    ("hopper", "hopper", "hopper_hop"),
    ("finger", "finger", "finger_spin"),
    ("walker_stand", "walker", "walker_stand"),
    ("lift_brick", "manipulation", "lift_brick"),
    ("ball_in_cup_catch", "ball_in_cup", "ball_in_cup_catch"),
    ("acrobot", "acrobot", "acrobot_swingup"),
    ("lqr_2_1", "lqr", "lqr_2_1"),
    ("gymnasium:HalfCheetah-v5", "gymnasium:HalfCheetah-v5", "gymnasium:HalfCheetah-v5"),
])  # fmt: skip
def test_a_name_leads_to_its_domain_and_task(name: str, domain: str, task: str) -> None:
    found = get_domain(name)
    assert (found.name, found.task) == (domain, task)


def test_tasks_of_a_domain_share_its_camera() -> None:
    assert get_domain("quadruped_walk").camera == get_domain("quadruped").camera == 2
    assert get_domain("reach_site").camera == "front_close"
    assert get_domain("gymnasium:HalfCheetah-v5").camera is None


@pytest.mark.parametrize(("wrong", "near"), [
    ("cheeta", "cheetah"), ("walker_wolk", "walker_walk"), ("reach_dupplo", "reach_duplo"),
    ("Finger-Spin", "finger_spin"), ("gymnasium:HalfCheeta-v5", "gymnasium:HalfCheetah-v5"),
    ("zzzz", "Domains: cheetah, walker"),
])  # fmt: skip
def test_an_unknown_name_is_answered_with_the_nearest_known_one(wrong: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=near) as caught:
        get_domain(wrong)
    assert wrong.removeprefix("gymnasium:") in str(caught.value)


def test_tasks_of_one_own_domain_stay_known_beside_each_other() -> None:
    soft = register_domain(Domain("lander", "lander_soft", make=make_nothing))
    assert get_domain("lander") is get_domain("lander_soft") is get_domain(soft) is soft
    hard = register_domain(Domain("lander", "lander_hard", make=make_nothing))
    assert get_domain("lander_soft") is soft
    assert get_domain("lander_hard") is get_domain("lander") is hard
    again = register_domain(Domain("lander", "lander_soft", camera=1, make=make_nothing))
    assert get_domain("lander_soft") is again
    with pytest.raises(UnknownNameError, match="lander"):
        get_domain("landr")


@pytest.mark.parametrize(("names", "domains"), [
    ("A", ["cheetah", "walker", "quadruped"]),
    ("B", ["cartpole", "pendulum", "manipulation"]),
    ("C", ["manipulation", "hopper", "finger"]),
    ("D", ["walker", "pendulum", "hopper"]),
    (["A", "D", "finger_spin"], ["cheetah", "walker", "quadruped", "pendulum", "hopper", "finger_spin"]),
    ("walker", ["walker"]),
    (PAPER_DOMAINS["walker"], [PAPER_DOMAINS["walker"]]),
])  # fmt: skip
def test_letters_stand_for_the_papers_groups_and_a_text_is_one_name(names: Any, domains: list[Any]) -> None:
    assert expand_groups(names) == domains


@pytest.mark.parametrize(("names", "complaint"), [([], "at least one"), (["E"], "'E'"), ("AB", "'AB'")])
def test_no_name_and_an_unknown_one_are_refused(names: Any, complaint: str) -> None:
    with pytest.raises(UnknownNameError, match=complaint):
        expand_groups(names)


def test_numbers_of_a_domain_are_the_plain_numbers_they_mean() -> None:
    domain = Domain("lander", "lander", make=make_nothing, action_repeat=np.int64(4), episode_env_steps=1e3)
    assert repr((domain.action_repeat, domain.episode_env_steps)) == "(4, 1000)"
    with pytest.raises(ValueError, match="action_repeat"):
        Domain("lander", "lander", make=make_nothing, action_repeat=0)


@pytest.mark.parametrize("name", ["walker", "A", "reach_duplo", "gymnasium:X"])
def test_a_built_in_name_is_refused(name: str) -> None:
    with pytest.raises(CRPTproError, match="is a name of the paper's or of Gymnasium"):
        register_domain(Domain(name, "own", make=make_nothing))


def test_looking_up_names_does_not_import_dm_control(monkeypatch: pytest.MonkeyPatch) -> None:
    # The import would fix the render backend before it can be chosen.
    monkeypatch.setitem(sys.modules, "dm_control", None)  # makes "import dm_control" raise
    get_domain("dog_run")
    get_domain("place_cradle")
    with pytest.raises(UnknownNameError):
        get_domain("nothing_like_it")


@pytest.mark.gl
def test_the_written_task_tables_are_those_of_the_installed_dm_control() -> None:
    from crptpro.envs.rendering import select_backend

    select_backend()
    from dm_control import manipulation, suite

    written = {(domain, task) for domain, tasks in domains.SUITE_TASKS.items() for task in tasks}
    assert written == {(d, f"{d}_{t.removeprefix(f'{d}_')}") for d, t in suite.ALL_TASKS}
    vision = {name.removesuffix("_vision") for name in manipulation.ALL if name.endswith("_vision")}
    assert set(domains.MANIPULATION_TASKS) == vision

"""Active pre-training that is killed, continued, or found finished."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from active_world import explore, make_loss, rows, same_state, toy_env
from dying import killed_in

from crptpro.errors import CheckpointError
from crptpro.training.explore.member import Member
from crptpro.training.explore.run import ActiveRun


def no_world(domain: str, **settings: object) -> object:
    raise AssertionError("a world was made")


@pytest.mark.parametrize(
    ("method", "domains", "turn"),
    [
        ("proto-rl-c", ("even", "odd"), 15),  # before the first checkpoint
        ("proto-rl-c", ("varied", "even", "odd"), 90),
        ("proto-rl-s", ("varied",), 90),
        ("apt-c", ("even", "odd"), 90),
        ("apt-s", ("even",), 90),
        ("becl", ("even", "varied"), 90),
    ],
)
def test_killed_in_the_middle_of_an_episode_it_ends_with_the_same_weights_and_records(
    tmp_path: Path, method: str, domains: tuple[str, ...], turn: int
) -> None:
    whole, expected = explore(tmp_path / "whole", domains, make_loss(method))
    with killed_in(ActiveRun, "_turn", lambda run: run.decisions == turn):
        explore(tmp_path / "killed", domains, make_loss(method))
    resumed, result = explore(tmp_path / "killed", domains, make_loss(method))
    assert (result.resumed_from > 0) == (turn > 20)
    assert same_state(whole, resumed)
    assert all(same_state(expected.actors[name], result.actors[name]) for name in expected.actors)
    for name in ("pretrain.csv", "explore.csv", "episodes.csv"):
        assert rows(tmp_path / "killed" / name) == rows(tmp_path / "whole" / name), name


def test_a_finished_run_is_found_again_and_changes_nothing(tmp_path: Path) -> None:
    loss, first = explore(tmp_path)
    before = {name: rows(tmp_path / name) for name in ("pretrain.csv", "episodes.csv")}
    again, second = explore(tmp_path)
    assert same_state(loss, again)
    assert second.updates == first.updates
    assert second.metrics == first.metrics
    assert {name: rows(tmp_path / name) for name in before} == before
    assert again.training_record["collapse"] == loss.training_record["collapse"]


def test_a_ring_shorter_than_the_run_survives_a_kill(tmp_path: Path) -> None:
    whole, _ = explore(tmp_path / "whole", replay_capacity=20)
    with killed_in(Member, "decide", lambda member: member.agent_steps == 44):
        explore(tmp_path / "killed", replay_capacity=20)
    resumed, _ = explore(tmp_path / "killed", replay_capacity=20)
    assert same_state(whole, resumed)


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    explore(tmp_path)
    with pytest.raises(CheckpointError, match="encoder_update_interval was 2, now 3"):
        explore(tmp_path, encoder_update_interval=3)
    with pytest.raises(CheckpointError, match="channels_last was 'absent', now False"):
        explore(tmp_path, channels_last="off")
    with pytest.raises(CheckpointError, match="already holds a run"):
        explore(tmp_path, resume=False)


def test_a_world_that_does_not_repeat_itself_is_announced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with killed_in(ActiveRun, "_turn", lambda run: run.decisions == 50):
        explore(tmp_path)

    def another_world(domain: str, *, seed: int, **settings) -> object:
        env = toy_env(domain, seed=seed, **settings)
        set_seed = env.set_seed
        env.set_seed = lambda seed, **_: set_seed(seed + 1)  # type: ignore[method-assign]
        return env

    explore(tmp_path, env_factory=another_world)
    assert "does not repeat an episode" in caplog.text


def test_short_episodes_cost_frames_and_a_killed_run_of_them_is_continued_too(tmp_path: Path) -> None:
    """Each episode has one frame more than decisions; with few decisions the ring wraps early."""
    whole, _ = explore(tmp_path / "whole", ("varied",), env_steps=1_200)
    with killed_in(ActiveRun, "_turn", lambda run: run.decisions == 590):
        explore(tmp_path / "killed", ("varied",), env_steps=1_200)
    resumed, _ = explore(tmp_path / "killed", ("varied",), env_steps=1_200)
    assert same_state(whole, resumed)


@pytest.mark.parametrize("begun_in", ["fp32", "bf16"])
def test_a_run_goes_on_in_the_arithmetic_that_it_began_in_on_a_machine_with_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun_in: str
) -> None:
    whole, _ = explore(None, precision=begun_in)
    monkeypatch.setattr("crptpro.modules.precision._is_cpu_faster_in_bf16", lambda: begun_in == "bf16")
    with killed_in(ActiveRun, "_turn", lambda run: run.decisions == 70):
        explore(tmp_path, precision="auto")
    monkeypatch.setattr("crptpro.modules.precision._is_cpu_faster_in_bf16", lambda: begun_in != "bf16")
    resumed, result = explore(tmp_path, precision="auto")
    assert result.resumed_from > 0
    assert result.precision == begun_in
    assert same_state(whole, resumed)


def test_another_budget_is_refused_by_name_and_nothing_is_built_for_it(tmp_path: Path) -> None:
    explore(tmp_path)

    with pytest.raises(CheckpointError, match="env_steps was 240, now 300"):
        explore(tmp_path, env_steps=300, env_factory=no_world)


def test_an_attempt_without_a_checkpoint_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    with killed_in(ActiveRun, "_turn", lambda run: True):
        explore(tmp_path, replay_capacity=20)
    _, result = explore(tmp_path, replay_capacity=50)
    assert result.env_steps == 240


def test_a_finished_run_needs_neither_its_replays_nor_its_worlds(tmp_path: Path) -> None:
    loss, first = explore(tmp_path)
    shutil.rmtree(tmp_path / "replay")

    again, second = explore(tmp_path, env_factory=no_world)
    assert same_state(loss, again)
    assert all(same_state(first.actors[name], second.actors[name]) for name in first.actors)
    assert torch.equal(loss.queue, again.queue)
    assert not (tmp_path / "replay").exists()

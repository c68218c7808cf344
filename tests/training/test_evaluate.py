"""Deterministic evaluation of whole episodes."""

from __future__ import annotations

import os
from typing import Any

import pytest
import torch
from worlds import EPISODE, make_encoder, make_toy_env

from crptpro.errors import NonFiniteError
from crptpro.modules import SquashedGaussianActor
from crptpro.training import PixelAgent, evaluate, summarize, uniform_policy
from crptpro.training.evaluate import Episode, Evaluator


def make_agent(seed: int = 0) -> PixelAgent:
    torch.manual_seed(seed)
    encoder = make_encoder(9).requires_grad_(False)
    return PixelAgent(encoder, SquashedGaussianActor(encoder.feature_dim, 2, hidden_dim=16))


def make_env() -> Any:
    return make_toy_env("toy", seed=0)


def test_an_evaluation_is_the_same_whatever_was_evaluated_before() -> None:
    env, agent = make_env(), make_agent()
    first = evaluate(agent, env, episodes=3, seed=5, progress=False)
    evaluate(agent, env, episodes=2, seed=9, progress=False)
    assert evaluate(agent, env, episodes=3, seed=5, progress=False) == first
    assert [episode.agent_steps for episode in first] == [EPISODE] * 3
    assert len({episode.seed for episode in first}) == 3


def test_chance_is_uniform_and_seeded() -> None:
    env = make_env()
    one, two = (evaluate(uniform_policy(env, seed=s), env, episodes=2, progress=False) for s in (0, 0))
    assert one == two
    assert evaluate(uniform_policy(env, seed=1), env, episodes=2, progress=False) != one


def test_a_summary_has_the_unbiased_deviation() -> None:
    episodes = [Episode(index, value, 10, 0) for index, value in enumerate((1.0, 2.0, 6.0))]
    assert summarize(episodes) == {"mean": 3.0, "std": pytest.approx(7.0**0.5), "min": 1.0, "max": 6.0}
    assert summarize(episodes[:1])["std"] == 0.0


def test_a_non_finite_action_names_the_episode_and_the_decision() -> None:
    calls = 0

    def policy(pixels: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return torch.full((2,), float("nan") if calls == EPISODE + 4 else 0.1)

    with pytest.raises(NonFiniteError, match="episode 1, decision 3: the policy acts"):
        evaluate(policy, make_env(), episodes=2, progress=False)


@pytest.mark.parametrize("episodes", [0, 1.5, "2"])
def test_an_impossible_number_of_episodes_is_refused(episodes: Any) -> None:
    with pytest.raises(ValueError, match="`episodes` must be"):
        evaluate(make_agent(), make_env(), episodes=episodes, progress=False)


def collect(workers: int, make: Any = make_env) -> tuple[Evaluator, list[Any]]:
    results: list[Any] = []
    evaluator = Evaluator(
        make, episodes=3, seed=1, workers=workers, progress=False,
        on_result=lambda episodes, counters: results.append((episodes, dict(counters))),
    )  # fmt: skip
    return evaluator, results


def test_workers_evaluate_a_snapshot_and_hand_it_out_when_asked() -> None:
    here, found = collect(0)
    agent = make_agent()
    here.start(agent, env_steps=40)
    beside, results = collect(2)
    beside.start(agent, env_steps=40)
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.zero_()
    assert results == []
    beside.finish()
    assert results == found
    assert results[0][1] == {"env_steps": 40}
    for evaluator in (here, beside):
        evaluator.close()


def test_an_evaluation_under_way_is_part_of_a_checkpoint() -> None:
    beside, results = collect(2)
    beside.agent = make_agent()
    beside.start(beside.agent, env_steps=40)
    state = beside.state_dict()
    beside.finish()
    again, repeated = collect(0)
    again.agent = make_agent(seed=7)
    again.load_state_dict(state)
    again.finish()
    # The encoder is frozen and the run's own; only what learns is in the state.
    assert [counters for _, counters in repeated] == [counters for _, counters in results]
    assert again.state_dict() == {}
    for evaluator in (beside, again):
        evaluator.close()


def die() -> Any:
    os._exit(3)


def test_lost_workers_are_replaced_by_this_process(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluator, results = collect(1, die)
    evaluator.start(make_agent(), env_steps=0)
    monkeypatch.setattr(evaluator, "make_env", make_env)
    with caplog.at_level("WARNING", logger="crptpro"):
        evaluator.finish()
    assert len(results) == 1
    assert "evaluating in this process from here on" in caplog.text
    evaluator.close()


def test_a_world_that_no_worker_can_build_is_evaluated_here() -> None:
    evaluator, results = collect(2, lambda: make_env())
    evaluator.start(make_agent(), env_steps=0)
    assert len(results) == 1
    evaluator.close()

"""Deterministic evaluation of whole episodes."""

from __future__ import annotations

import functools
import multiprocessing
import os
import time
from typing import Any

import pytest
import torch
from tensordict.nn import InteractionType, TensorDictModule
from torchrl.data import Unbounded
from torchrl.envs import StepCounter, TensorDictPrimer, TransformedEnv
from torchrl.modules import ProbabilisticActor, RandomPolicy, TanhNormal
from toy_env import PoisonedEnv, ToyEnv, fixed_length
from toy_runs import EPISODE, SIZE, make_encoder, toy_domain

from crptpro.envs import make_env
from crptpro.errors import CRPTproError, NonFiniteError
from crptpro.modules import SquashedGaussianActor
from crptpro.training import PixelAgent, evaluate, summarize, uniform_policy
from crptpro.training.evaluate import Episode, Evaluator

make_toy_env = functools.partial(make_env, toy_domain("toy"), seed=0, image_size=SIZE)


def make_agent(seed: int = 0) -> PixelAgent:
    torch.manual_seed(seed)
    encoder = make_encoder(9).requires_grad_(False)
    return PixelAgent(encoder, SquashedGaussianActor(encoder.feature_dim, 2, hidden_dim=16))


def test_an_evaluation_is_the_same_whatever_was_evaluated_before() -> None:
    env, agent = make_toy_env(), make_agent()
    first = evaluate(agent, env, episodes=3, seed=5, progress=False)
    evaluate(agent, env, episodes=2, seed=9, progress=False)
    assert evaluate(agent, env, episodes=3, seed=5, progress=False) == first
    assert [episode.agent_steps for episode in first] == [EPISODE] * 3
    assert len({episode.seed for episode in first}) == 3


def test_chance_is_uniform_and_seeded() -> None:
    env = make_toy_env()
    one, two, other = (evaluate(uniform_policy(env, seed=s), env, episodes=2, progress=False) for s in (0, 0, 1))
    assert one == two
    assert other != one


def test_a_summary_has_the_unbiased_deviation() -> None:
    episodes = [Episode(index, value, 10, 0) for index, value in enumerate((1.0, 2.0, 6.0))]
    assert summarize(episodes) == {"mean": 3.0, "std": pytest.approx(7.0**0.5), "min": 1.0, "max": 6.0}
    assert summarize(episodes[:1])["std"] == 0.0


def test_a_policy_of_torchrl_acts_as_the_function_that_it_wraps() -> None:
    env, agent = make_toy_env(), make_agent()
    expected = evaluate(agent, env, episodes=1, seed=5, progress=False)
    wrapped = TensorDictModule(agent, ["pixels"], ["action"])
    assert evaluate(wrapped, env, episodes=1, seed=5, progress=False) == expected
    assert len(evaluate(RandomPolicy(env.full_action_spec), env, episodes=1, progress=False)) == 1


class Counting(torch.nn.Module):
    """A recurrent policy whose state counts its calls, and whose action is drawn."""

    def forward(self, pixels: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        self.seen.append(int(state))
        return torch.zeros(2), torch.full((2,), 0.3), state + 1


def test_a_policy_of_torchrl_keeps_its_recurrent_state_and_acts_by_its_mode() -> None:
    env = TransformedEnv(make_toy_env(), TensorDictPrimer(state=Unbounded((1,)), default_value=0.0))
    network = Counting()
    network.seen = []
    module = TensorDictModule(network, ["pixels", "state"], ["loc", "scale", ("next", "state")])
    policy = ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=TanhNormal, default_interaction_type=InteractionType.RANDOM
    )
    returns = [evaluate(policy, env, episodes=1, seed=3, progress=False)[0].episode_return for _ in range(2)]
    assert network.seen == 2 * list(range(EPISODE))
    assert returns[0] == returns[1] == evaluate(lambda _: torch.zeros(2), env, episodes=1, seed=3)[0].episode_return


def test_a_policy_may_return_its_action_alone_or_need_gradients() -> None:
    env = TransformedEnv(make_toy_env(), StepCounter())
    expected = evaluate(lambda _: torch.zeros(2), env, episodes=1, progress=False)
    alone = TensorDictModule(lambda pixels: torch.zeros(2), ["pixels"], ["action"], inplace=False)

    def planned(_: torch.Tensor) -> torch.Tensor:
        action = torch.ones(2, requires_grad=True)
        return action - torch.autograd.grad(action.square().sum() / 2, action)[0]

    for policy in (alone, planned):
        assert evaluate(policy, env, episodes=1, progress=False) == expected


@pytest.mark.parametrize(("policy", "got"), [
    (lambda pixels: torch.zeros(3), r"\(3,\)"), (lambda pixels: torch.zeros(1, 2), r"\(1, 2\)"),
    (lambda pixels: [0.0, 0.0], "list"), (TensorDictModule(torch.nn.Identity(), ["pixels"], ["features"]), "NoneType"),
])  # fmt: skip
def test_a_policy_that_returns_no_action_of_the_environment_is_refused(policy: Any, got: str) -> None:
    with pytest.raises(ValueError, match=rf"agent step 0: the policy returned {got} for an action of shape \(2,\)"):
        evaluate(policy, make_toy_env(), episodes=1, progress=False)


def test_an_environment_that_was_closed_says_so() -> None:
    env = make_toy_env()
    env.close()
    with pytest.raises(CRPTproError, match="'toy_go' is closed"):
        evaluate(make_agent(), env, episodes=1, progress=False)


def test_a_non_finite_action_names_the_environment_the_episode_and_the_step_and_says_what_it_means() -> None:
    actions = iter([0.1] * (EPISODE + 3) + [float("nan")])
    with pytest.raises(NonFiniteError, match=r"'toy_go' .* agent step 4 of episode 1 .* training has diverged"):
        evaluate(lambda _: torch.full((2,), next(actions)), make_toy_env(), episodes=2, progress=False)


def test_a_reward_of_an_unchecked_environment_that_is_not_finite_names_the_episode_and_keeps_those_before() -> None:
    kept: list[Episode] = []
    with pytest.raises(NonFiniteError, match="episode 1: the rewards sum to nan"):
        evaluate(
            lambda _: torch.zeros(2), PoisonedEnv(fixed_length), episodes=3, progress=False, on_episode=kept.append
        )
    assert [episode.episode for episode in kept] == [0]


def evaluator(workers: int, make: Any = make_toy_env, seed: int = 0) -> tuple[Evaluator, list[Any]]:
    results: list[Any] = []
    found = Evaluator(
        make, make_agent(seed), episodes=2, seed=1, workers=workers, progress=False,
        on_result=lambda episodes, counters: results.append((episodes, dict(counters))),
    )  # fmt: skip
    return found, results


def test_workers_evaluate_a_snapshot_hand_it_out_when_asked_and_it_is_part_of_a_checkpoint() -> None:
    here, expected = evaluator(0)
    here.start(env_steps=40)
    assert expected[0][1] == {"env_steps": 40}
    beside, results = evaluator(2)
    beside.start(env_steps=40)
    with torch.no_grad():
        for parameter in beside.agent.actor.parameters():
            parameter.zero_()
    state = beside.state_dict()
    assert results == []
    beside.finish()
    assert results == expected
    again, repeated = evaluator(0, seed=7)
    again.load_state_dict(state)
    assert repeated == []  # the run has not restored its record yet
    again.finish()
    assert repeated == expected
    assert again.state_dict() == {}
    for each in (here, beside, again):
        each.close()


def test_an_evaluation_that_has_ended_is_delivered_once_when_the_run_asks() -> None:
    running, results = evaluator(1)
    running.poll()
    running.start(env_steps=40)
    running.poll()  # the worker has not even imported torch
    assert results == []
    deadline = time.monotonic() + 120
    while not results and time.monotonic() < deadline:
        time.sleep(0.05)
        running.poll()
    assert [counters for _, counters in results] == [{"env_steps": 40}]
    running.close()


def die() -> Any:
    os._exit(3)


def test_lost_workers_are_replaced_by_this_process(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost, results = evaluator(1, die)
    lost.start(env_steps=0)
    monkeypatch.setattr(lost, "make_env", make_toy_env)
    with caplog.at_level("WARNING", logger="crptpro"):
        lost.finish()
    assert len(results) == 1
    assert "evaluating in this process from here on" in caplog.text
    lost.close()


def test_workers_that_die_between_two_evaluations_are_replaced_by_this_process(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lost, results = evaluator(1)
    lost.start(env_steps=0)
    lost.finish()
    for process in multiprocessing.active_children():
        process.kill()
        process.join()
    with caplog.at_level("WARNING", logger="crptpro"):
        lost.start(env_steps=40)
        lost.finish()
    assert [counters for _, counters in results] == [{"env_steps": 0}, {"env_steps": 40}]
    assert "evaluating in this process from here on" in caplog.text
    lost.close()


class BrokenEnv(ToyEnv):
    """Fails as its driver does."""

    def _reset(self, tensordict: Any = None, **options: Any) -> Any:
        raise OSError("the camera is gone")


def test_an_error_of_the_environment_is_no_lost_worker(caplog: pytest.LogCaptureFixture) -> None:
    failing, _ = evaluator(1, functools.partial(BrokenEnv, fixed_length))
    failing.start(env_steps=0)
    with caplog.at_level("WARNING", logger="crptpro"), pytest.raises(OSError, match="the camera is gone"):
        failing.finish()
    assert not caplog.records
    failing.close()


def test_closing_ends_an_evaluation_that_is_under_way() -> None:
    before = multiprocessing.active_children()
    stopped, results = evaluator(1)
    stopped.start(env_steps=0)
    stopped.close()
    assert multiprocessing.active_children() == before
    assert results == []


@pytest.mark.parametrize("make", [make_toy_env, lambda: make_toy_env()])
def test_what_no_worker_can_build_is_evaluated_here(make: Any) -> None:
    class LocalActor(SquashedGaussianActor):
        """As in a notebook: no other process can import it."""

    alone, results = evaluator(0, make)
    if make is make_toy_env:
        alone.agent.actor.__class__ = LocalActor
    alone = Evaluator(
        make, alone.agent, episodes=2, seed=1, workers=2, progress=False,
        on_result=lambda episodes, counters: results.append(episodes),
    )  # fmt: skip
    alone.start(env_steps=0)
    assert len(results) == 1
    alone.close()

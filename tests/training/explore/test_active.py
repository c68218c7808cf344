"""What active pre-training does with its budget, its domains, its losses and its worlds."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import torch
from active_world import explore, make_loss, rows, same_state, toy_env
from tensordict import TensorDictBase

from crptpro.errors import CRPTproError, NonFiniteError
from crptpro.modules import is_channels_last
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training.explore.run import ActiveRun
from crptpro.training.rad_sac_learner import RADSACLearner


def gradients_of(loss: torch.nn.Module) -> dict[str, torch.Tensor | None]:
    return {
        name: None if parameter.grad is None else parameter.grad.clone()
        for name, parameter in loss.named_parameters()
    }


def same_gradients(one: dict[str, torch.Tensor | None], two: dict[str, torch.Tensor | None]) -> bool:
    def is_same(a: torch.Tensor | None, b: torch.Tensor | None) -> bool:
        return a is b if a is None or b is None else torch.equal(a, b)

    return one.keys() == two.keys() and all(is_same(one[name], two[name]) for name in one)


def test_it_spends_its_budget_and_says_so_in_env_steps_and_encoder_updates(tmp_path: Path) -> None:
    loss, result = explore(tmp_path)
    assert result.env_steps == 240
    # 60 decisions in each of two domains, the first 10 without updates, then one encoder update every second.
    assert result.updates == 2 * 25
    assert loss.training_record["env_steps"] == 240
    assert loss.training_record["updates"] == 50
    assert [facts["agent_steps"] for facts in loss.training_record["datasets"]] == [60, 60]


def test_the_layout_is_the_runs_and_is_recorded() -> None:
    loss, _ = explore(None, channels_last="off")
    usual, _ = explore(None)
    assert (loss.training_record["channels_last"], usual.training_record["channels_last"]) == (False, True)
    assert is_channels_last(loss)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_no_domain_is_starved_whatever_their_number(
    count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Counted over all domains, "every second decision" would always fall on the same ones of an even number."""
    updated: list[str] = []
    original = ActiveRun._update

    def spy(run: ActiveRun, index: int) -> None:
        before = run.updates
        original(run, index)
        updated.extend([run.domains[index]] * (run.updates - before))

    monkeypatch.setattr(ActiveRun, "_update", spy)
    domains = ("a", "b", "c", "d")[:count]
    explore(
        None,
        domains,
        env_steps=2 * count * 30,
        env_factory=lambda domain, **settings: toy_env("even", **settings),
    )
    assert {name: updated.count(name) for name in domains} == dict.fromkeys(domains, 10)
    assert updated[:count] == list(domains), "domains take turns"


def test_only_the_self_supervised_loss_trains_the_encoder_and_only_the_intrinsic_reward_the_agent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved, seen = [], []
    original = ActiveRun._update

    def spy(run: ActiveRun, index: int) -> None:
        before = {key: value.clone() for key, value in run.loss.encoder.state_dict().items()}
        updates = run.updates
        agent = run.members[index].agent
        update = agent.update

        def agent_update(batch, *, agent_step):
            assert torch.equal(batch["next", "reward"], batch["next", "intrinsic_reward"])
            encoder = {key: value.clone() for key, value in run.loss.encoder.state_dict().items()}
            gradients = gradients_of(run.loss)
            metrics = update(batch, agent_step=agent_step)
            after = run.loss.encoder.state_dict()
            assert all(torch.equal(after[key], encoder[key]) for key in after)
            assert same_gradients(gradients_of(run.loss), gradients)
            seen.append(agent_step)
            return metrics

        agent.update = agent_update
        original(run, index)
        agent.update = update
        after = run.loss.encoder.state_dict()
        moved.append((run.updates - updates, any(not torch.equal(after[key], before[key]) for key in after)))

    monkeypatch.setattr(ActiveRun, "_update", spy)
    explore(None)
    assert seen
    assert all(changed == bool(updates) for updates, changed in moved)


def test_the_same_seed_gives_the_same_weights_and_another_seed_others() -> None:
    (one, first), (two, second), (other, third) = explore(None), explore(None), explore(None, seed=1)
    assert same_state(one, two)
    assert all(same_state(first.actors[name], second.actors[name]) for name in first.actors)
    assert not same_state(first.actors["even"], third.actors["even"])
    assert not same_state(one, other)


def test_drawing_ahead_in_other_threads_changes_no_number(tmp_path: Path) -> None:
    one, first = explore(tmp_path / "in turn", render_ahead=False)
    two, second = explore(tmp_path / "ahead", render_ahead=True)
    assert same_state(one, two)
    assert all(same_state(first.actors[name], second.actors[name]) for name in first.actors)
    for name in ("pretrain.csv", "explore.csv", "episodes.csv"):
        assert rows(tmp_path / "in turn" / name) == rows(tmp_path / "ahead" / name)


def test_a_single_domain_method_refuses_several_domains_and_a_domain_twice() -> None:
    with pytest.raises(CRPTproError, match="proto-rl-s pre-trains on one domain, got 2"):
        explore(None, loss=make_loss("proto-rl-s"))
    with pytest.raises(CRPTproError, match="named twice"):
        explore(None, ("even", "even"))


def test_a_budget_without_any_update_is_refused() -> None:
    with pytest.raises(CRPTproError, match="no update of encoder or explorer would ever happen"):
        explore(None, env_steps=40, random_agent_steps=10)


def test_a_budget_per_domain_gives_each_domain_all_of_it() -> None:
    _, result = explore(None, steps_budget="per_domain", env_steps=60)
    assert result.env_steps == 120


def test_a_diverged_explorer_stops_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    original = ActiveRun._update

    def spoil(run: ActiveRun, index: int) -> None:
        original(run, index)
        with torch.no_grad():
            next(run.members[index].agent.actor.parameters()).fill_(float("nan"))

    monkeypatch.setattr(ActiveRun, "_update", spoil)
    with pytest.raises(NonFiniteError, match="explorer of even acts"):
        explore(None, checkpoint_interval_env_steps=1_000)
    with pytest.raises(NonFiniteError, match=r"trunk\.linear\.weight is not finite"):
        explore(None, checkpoint_interval_env_steps=4)


def test_the_artifact_carries_the_candidates_to_the_downstream_stage(tmp_path: Path) -> None:
    loss, _ = explore(None)
    save_pretrained(loss, tmp_path / "encoder")
    pretrained = load_pretrained(tmp_path / "encoder")
    assert pretrained.method == "proto-rl-c"
    assert pretrained.queue is not None
    assert pretrained.queue.shape == (16, 4)
    assert pretrained.queue.norm(dim=-1).min() > 0.99, "the queue has been filled"
    assert pretrained.card["training"]["env_steps"] == 240


def test_a_queue_per_domain_keeps_candidates_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[ActiveRun] = []
    original = ActiveRun.finish

    def spy(run: ActiveRun):
        runs.append(run)
        return original(run)

    monkeypatch.setattr(ActiveRun, "finish", spy)
    explore(None)
    explore(None, per_domain_queue=True)
    shared, apart = runs
    assert shared.rewards[0] is shared.rewards[1]
    assert apart.rewards[0] is not apart.rewards[1]


def test_a_world_that_fails_is_named_and_the_others_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def fragile(domain: str, **settings: object) -> object:
        env = toy_env(domain, **settings)
        made.append(env)
        if domain == "odd":
            step = env.step
            env.step = lambda td: step(td) if env.base_env.steps < 5 else 1 / 0
        return env

    with pytest.raises(
        CRPTproError, match=r"The world of odd failed in episode 0, decision 5: ZeroDivisionError"
    ):
        explore(None, env_factory=fragile)
    assert all(env.is_closed for env in made)


def test_names_that_are_no_directories_or_columns_are_refused() -> None:
    for name in ("../outside", "", "a,b"):
        with pytest.raises(CRPTproError, match="cannot name a directory and a column"):
            explore(None, (name,), env_factory=lambda domain, **settings: toy_env("even", **settings))


def test_delays_within_an_agent_count_its_own_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    actor_updates: list[bool] = []
    original = RADSACLearner._advance

    def spy(learner: RADSACLearner, td: TensorDictBase, with_actor: bool, with_target: bool) -> dict:
        actor_updates.append(with_actor)
        return original(learner, td, with_actor, with_target)

    monkeypatch.setattr(RADSACLearner, "_advance", spy)
    for interval in (1, 2):
        actor_updates.clear()
        explore(None, ("even",), loss=make_loss("proto-rl-s"), agent_update_interval=interval)
        assert sum(actor_updates) == pytest.approx(len(actor_updates) / 2, abs=1)


def test_settings_that_nothing_reads_are_said(caplog: pytest.LogCaptureFixture) -> None:
    explore(None, loss=make_loss("apt-c"), per_domain_queue=True, knn_k=3)
    assert "`per_domain_queue` True changes nothing: neither the reward particle nor" in caplog.text
    assert "`queue_size` 16 changes nothing" in caplog.text
    assert "knn_k" not in caplog.text


def draws() -> tuple[float, float, float]:
    """One of each global generator."""
    return random.random(), float(np.random.rand()), float(torch.rand(()))  # noqa: NPY002


def test_the_callers_generators_are_left_as_they_were(tmp_path: Path) -> None:
    losses = [make_loss() for _ in range(3)]
    explore(tmp_path, loss=losses[0], env_steps=120)
    seed_everything(5)
    expected = draws()
    seed_everything(5)
    explore(tmp_path, loss=losses[1], env_steps=120)
    explore(None, loss=losses[2], env_steps=120)
    assert draws() == expected


def test_the_actor_of_a_skill_explorer_is_loaded_again(tmp_path: Path) -> None:
    loss, result = explore(None, ("even",), loss=make_loss("becl"))
    save_pretrained(loss, tmp_path / "encoder", actor=result.actors["even"])
    actor = load_pretrained(tmp_path / "encoder").actor
    assert all(torch.equal(a, b) for a, b in zip(actor.parameters(), result.actors["even"].parameters()))

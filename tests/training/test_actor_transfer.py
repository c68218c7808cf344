from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from test_downstream import SMALL, small_pretrained, train

from crptpro.errors import PretrainedError
from crptpro.modules import DeterministicActor, SquashedGaussianActor
from crptpro.pretrained import Pretrained, load_pretrained, save_pretrained
from crptpro.training.actor_transfer import transferred_actor
from crptpro.training.downstream_run import DownstreamRun


def explored(domain: str = "toy", action_dim: int = 2) -> Pretrained:
    pretrained = small_pretrained()
    pretrained.actor = SquashedGaussianActor(
        pretrained.encoder.feature_dim, action_dim, bottleneck_dim=5, hidden_dim=8
    )
    pretrained.card = {"method": "proto-rl-s", "training": {"datasets": [{"domain": domain}]}}
    return pretrained


def test_an_actor_of_the_tasks_domain_goes_on_and_any_other_does_not() -> None:
    for task, domain, is_taken in (
        ("cheetah_run", "cheetah", True),
        ("walker_stand", "walker", True),
        ("walker_run", "cheetah", False),
    ):
        pretrained = explored(domain)
        actor = transferred_actor(task, pretrained, SMALL, action_dim=2)
        assert (actor is not None) == is_taken
        if actor is not None:
            assert actor is not pretrained.actor
            assert all(torch.equal(a, b) for a, b in zip(actor.parameters(), pretrained.actor.parameters()))
            assert all(parameter.requires_grad for parameter in actor.parameters())


def test_it_can_be_left_out_or_asked_for() -> None:
    asked, refused = (dataclasses.replace(SMALL, transfer_actor=choice) for choice in (True, False))
    assert transferred_actor("toy", explored(), refused, action_dim=2) is None
    assert transferred_actor("toy", explored("another"), asked, action_dim=2) is not None
    with pytest.raises(PretrainedError, match="has no actor"):
        transferred_actor("toy", small_pretrained(), asked, action_dim=2)
    skilled = explored()
    skilled.actor = DeterministicActor(skilled.encoder.feature_dim, 2, skill_dim=4, hidden_dim=8)
    assert transferred_actor("toy", skilled, SMALL, action_dim=2) is None
    with pytest.raises(PretrainedError, match="its actor is a DeterministicActor"):
        transferred_actor("toy", skilled, asked, action_dim=2)
    with pytest.raises(PretrainedError, match="its actor has 3 actions, toy has 2"):
        transferred_actor("toy", explored(action_dim=3), asked, action_dim=2)
    assert transferred_actor("toy", explored(action_dim=3), SMALL, action_dim=2) is None


def test_a_transferred_actor_acts_from_the_first_decision_and_learns_after_the_usual_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[DownstreamRun] = []
    original = DownstreamRun.train

    def spy(run: DownstreamRun, checkpoints: object) -> None:
        runs.append(run)
        before = {key: value.clone() for key, value in run.parts.algorithm.actor.state_dict().items()}
        first = pretrained.actor.state_dict()
        assert all(torch.equal(value, first[key]) for key, value in before.items())
        original(run, checkpoints)

    monkeypatch.setattr(DownstreamRun, "train", spy)
    pretrained = explored()
    result = train(tmp_path, pretrained, env_steps=30)
    assert result.evaluations[-1]["updates"] == 15 - 12
    # The uniform stream was never asked.
    untouched = torch.Generator().manual_seed(runs[0].generators["random_actions"].initial_seed())
    assert torch.equal(runs[0].generators["random_actions"].get_state(), untouched.get_state())
    moved = result.policy.actor.state_dict()
    assert any(not torch.equal(value, moved[key]) for key, value in pretrained.actor.state_dict().items())


def test_the_artifact_keeps_the_actor(tmp_path: Path) -> None:
    pretrained = explored()
    loaded = load_pretrained(save_pretrained(pretrained, tmp_path / "encoder"))
    assert isinstance(loaded.actor, SquashedGaussianActor)
    state = loaded.actor.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in pretrained.actor.state_dict().items())
    assert load_pretrained(save_pretrained(small_pretrained(), tmp_path / "without")).actor is None

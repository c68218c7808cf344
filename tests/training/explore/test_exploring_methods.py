"""What the methods differ in: rewards, agents, views, skills, looking ahead."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from active_world import SIZE, explore, make_loss

from crptpro.errors import CRPTproError, DatasetError, UnknownNameError
from crptpro.modules import PixelEncoder
from crptpro.objectives import (
    AveragedSACLoss,
    MethodDefaults,
    ProtoLoss,
    RADSACLoss,
    SkillDDPGLoss,
    get_method,
    register_method,
)
from crptpro.objectives import registry as registry_module
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import register_intrinsic_reward
from crptpro.training.explore import active
from crptpro.training.explore.run import ActiveRun
from crptpro.transforms import ParticleReward, PrototypeReward, SkillContrastReward


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list:
    """Batches that the first domain's agent was trained on, with the run."""
    seen: list = []
    original = ActiveRun._update

    def spy(run: ActiveRun, index: int) -> None:
        agent = run.members[index].agent
        update = agent.update

        def record(batch, *, agent_step):
            seen.append((run, batch))
            return update(batch, agent_step=agent_step)

        agent.update = record
        original(run, index)
        agent.update = update

    monkeypatch.setattr(ActiveRun, "_update", spy)
    return seen


@pytest.mark.parametrize(
    ("method", "agent_loss", "reward"),
    [
        ("proto-rl-c", RADSACLoss, PrototypeReward),
        ("apt-c", AveragedSACLoss, ParticleReward),
        ("becl", SkillDDPGLoss, SkillContrastReward),
    ],
)
def test_each_method_has_its_agent_and_its_reward(
    method: str, agent_loss: type, reward: type, batches: list
) -> None:
    explore(None, loss=make_loss(method))
    run, _ = batches[0]
    assert type(run.members[0].agent.loss) is agent_loss
    assert type(run.rewards[0].transform) is reward


def test_apt_sees_two_different_views_of_both_observations(batches: list) -> None:
    explore(None, loss=make_loss("apt-c"))
    _, batch = batches[0]
    for key in ("pixels", ("next", "pixels")):
        view = "pixels_view" if key == "pixels" else ("next", "pixels_view")
        assert not torch.equal(batch[key], batch[view])
    assert not torch.equal(batch["features"], batch["features_view"])


def test_becl_updates_three_times_on_batches_of_their_own_and_looks_three_decisions_ahead(
    batches: list,
) -> None:
    _, result = explore(None, loss=make_loss("becl"))
    assert result.updates == 3 * 2 * 25
    run, batch = batches[-1]
    assert batch["skill"].shape == (8, 16)
    # No termination within the window: gamma^3.
    alive = batch["next", "discount"] > 0
    torch.testing.assert_close(
        batch["next", "discount"][alive], torch.full((int(alive.sum()),), 0.99**3), rtol=0, atol=1e-6
    )
    assert [member.agent_steps for member in run.members] == [60, 60]


def test_becl_trains_its_agent_on_features_from_before_the_last_encoder_update_and_rewards_with_the_head_after_it(
    batches: list,
) -> None:
    explore(None, loss=make_loss("becl"))
    run, batch = batches[-1]  # nothing was updated after the last batch but the agent
    with torch.no_grad():
        now = run.loss.encoder(batch["next", "pixels"])
    assert not torch.equal(now, batch["next", "features"])
    again = run.rewards[0].transform.intrinsic_reward(batch["next", "features"], batch["skill"])
    torch.testing.assert_close(again, batch["next", "reward"].squeeze(-1))


def test_proto_rl_rewards_with_the_encoder_just_updated(batches: list) -> None:
    explore(None, env_steps=240 - 4)  # the last turn updates the encoder
    run, batch = batches[-1]
    with torch.no_grad():
        torch.testing.assert_close(run.loss.encoder(batch["next", "pixels"]), batch["next", "features"])


def test_skills_change_with_episodes_and_intervals_and_are_stored_with_the_transitions(batches: list) -> None:
    explore(None, ("even",), make_loss("becl"), skill_agent_steps=4)
    run, _ = batches[0]
    stored = run.members[0].replay[:]["skill"].argmax(-1)
    episodes = stored[: 10 * (len(stored) // 10)].view(-1, 10)
    for skills in episodes:
        for part in (skills[:4], skills[4:8], skills[8:]):
            assert part.unique().numel() == 1
    assert stored.unique().numel() > 3


def test_a_reward_of_ones_own_is_chosen_by_its_name(batches: list) -> None:
    class Constant(ParticleReward):
        def intrinsic_reward(self, features: torch.Tensor) -> torch.Tensor:
            return torch.full((len(features),), 0.25)

    def build(loss, config, generator):
        return Constant(None, reward_key=None)

    register_intrinsic_reward("constant", build)
    with pytest.raises(ValueError, match="already registered"):
        register_intrinsic_reward("constant", lambda *arguments: None)
    explore(None, reward="constant")
    assert all((batch["next", "reward"] == 0.25).all() for _, batch in batches)


def test_what_a_method_cannot_explore_with_is_refused_by_name() -> None:
    with pytest.raises(UnknownNameError, match=r"no intrinsic reward 'curiosity'; known: .*particle"):
        explore(None, reward="curiosity")
    with pytest.raises(UnknownNameError, match="no exploring agent 'ppo'; known: averaged-sac"):
        explore(None, agent="ppo")
    with pytest.raises(
        CRPTproError, match="needs a loss with projector and prototypes; SimCLRLoss has no prototypes"
    ):
        explore(None, loss=make_loss("apt-c"), reward="prototype")
    with pytest.raises(CRPTproError, match="skill-ddpg needs skills"):
        explore(None, agent="skill-ddpg")
    with pytest.raises(CRPTproError, match="skill-contrast needs skills"):
        explore(None, reward="skill-contrast")
    with pytest.raises(CRPTproError, match="A replay of 3 transitions holds no n_step of 3"):
        explore(None, loss=make_loss("becl"), replay_capacity=3)
    with pytest.raises(DatasetError, match="n_step=11"):
        explore(None, ("even",), loss=make_loss("becl"), n_step=11)
    with pytest.raises(CRPTproError, match="rad-sac learns from single transitions, got n_step 3"):
        explore(None, n_step=3)


def test_domains_share_candidates_but_no_running_scale(batches: list) -> None:
    """A reward is divided by the distances that its own agent has seen."""
    for method, is_shared in (("proto-rl-c", True), ("apt-c", False)):
        batches.clear()
        explore(None, loss=make_loss(method))
        run, _ = batches[0]
        assert (run.rewards[0] is run.rewards[1]) == is_shared


def test_the_loss_gets_the_candidates_in_the_order_they_will_be_replaced(batches: list) -> None:
    loss, _ = explore(None, per_domain_queue=False)
    run, _ = batches[0]
    transform = run.rewards[0].transform
    assert torch.equal(loss.queue[0], transform.queue[int(transform.queue_pointer)])


def test_an_encoder_without_the_methods_pixel_scaling_is_announced(caplog: pytest.LogCaptureFixture) -> None:
    loss = make_loss("becl")
    loss.encoder.config["pixel_offset"] = 0.0
    explore(None, loss=loss, env_steps=60)
    assert "becl wants an encoder with pixel_offset 0.5, this one has 0.0" in caplog.text


def proto_by_hand() -> ProtoLoss:
    torch.manual_seed(0)
    encoder = PixelEncoder(9, channels=(4, 4), strides=(2, 1), image_size=SIZE)
    return ProtoLoss(encoder, num_prototypes=8, latent_dim=4, hidden_dim=8, intr_loss_coef=0.0)


def test_the_artifact_of_a_loss_built_by_hand_bears_the_name_of_the_method_that_it_explored_as(
    tmp_path: Path,
) -> None:
    loss, _ = explore(None, loss=proto_by_hand())
    save_pretrained(loss, tmp_path / "encoder")
    method = load_pretrained(tmp_path / "encoder").method
    assert method == "proto-rl-c"
    assert get_method(method).replay_capacity == 100_000


def test_a_loss_of_a_derived_class_bears_no_methods_name() -> None:
    class Derived(ProtoLoss):
        pass

    loss = proto_by_hand()
    loss.__class__ = Derived
    explore(None, loss=loss)
    assert loss.method_name is None


def test_a_loss_that_has_explored_finds_its_finished_run_again(tmp_path: Path) -> None:
    loss, first = explore(tmp_path, loss=proto_by_hand())
    _, again = explore(tmp_path, loss=loss)
    assert again.resumed_from == first.updates


def test_a_run_of_a_version_that_did_not_name_a_loss_built_by_hand_is_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(active, "_name", lambda loss: None)
        _, first = explore(tmp_path, loss=proto_by_hand())
    _, again = explore(tmp_path, loss=proto_by_hand())
    assert again.resumed_from == first.updates


def test_a_method_registered_later_has_no_say_on_the_encoder_of_a_loss_built_by_hand(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(registry_module, "_METHODS", dict(registry_module._METHODS))
    register_method("ablation", ProtoLoss, MethodDefaults(), encoder_options={"pixel_offset": 0.5})
    explore(None, loss=proto_by_hand(), env_steps=60)
    assert "wants an encoder" not in caplog.text

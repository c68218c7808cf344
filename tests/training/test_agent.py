from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from crptpro.artifact import CARD_FILE, WEIGHTS_FILE
from crptpro.errors import CheckpointError
from crptpro.modules import DeterministicActor, FixedSkillActor, PixelEncoder, SquashedGaussianActor
from crptpro.pretrained import random_pretrained, save_pretrained
from crptpro.training.agent import PixelAgent, load_agent, save_agent

ENCODER = {"channels": (4, 4), "strides": (2, 1), "image_size": 16}


def make_agent(seed: int = 0) -> PixelAgent:
    torch.manual_seed(seed)
    encoder = PixelEncoder(**ENCODER)
    return PixelAgent(encoder, SquashedGaussianActor(encoder.feature_dim, 3, hidden_dim=8))


def observation(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (9, 16, 16), dtype=torch.uint8, generator=generator)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return save_agent(tmp_path / "agent", make_agent(), card={"task": "toy", "env_steps": 7})


def test_an_agent_acts_by_the_squashed_mean_of_the_unshifted_observation() -> None:
    agent, pixels = make_agent(), observation()
    mean, _ = agent.actor(agent.encoder(pixels.unsqueeze(0)))
    action = agent(pixels)
    torch.testing.assert_close(action, mean.tanh().squeeze(0).detach())
    assert (action.shape, action.dtype, action.requires_grad) == ((3,), torch.float32, False)
    assert torch.equal(agent(pixels), action)  # nothing is drawn
    assert not torch.equal(agent(observation(1)), action)


def test_an_agent_comes_back_bit_equal_with_its_card(saved: Path) -> None:
    agent, card = load_agent(saved)
    torch.testing.assert_close(agent(observation()), make_agent()(observation()), rtol=0, atol=0)
    assert (card["task"], card["env_steps"]) == ("toy", 7)
    assert "versions" in card
    assert not any(p.requires_grad for p in [*agent.encoder.parameters(), *agent.actor.parameters()])


def test_saving_again_replaces_the_agent_and_leaves_nothing_beside_it(saved: Path) -> None:
    save_agent(saved, make_agent(1), card={"task": "toy"})
    agent, _ = load_agent(saved)
    assert torch.equal(agent(observation()), make_agent(1)(observation()))
    assert [path.name for path in saved.parent.iterdir()] == ["agent"]


def test_what_is_missing_truncated_or_foreign_is_refused_by_name(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="nowhere does not exist"):
        load_agent(tmp_path / "nowhere")

    encoder = random_pretrained(**ENCODER)
    from crptpro.objectives import ProtoLoss

    loss = ProtoLoss(encoder.encoder.requires_grad_(True), num_prototypes=4, latent_dim=4, hidden_dim=4)
    other = save_pretrained(loss, tmp_path / "encoder")
    with pytest.raises(CheckpointError, match=r"encoder is a 'crptpro-pretrained', expected 'crptpro-agent'"):
        load_agent(other)

    card = json.loads((saved / CARD_FILE).read_text())
    (saved / CARD_FILE).write_text(json.dumps({**card, "version": 99}))
    with pytest.raises(CheckpointError, match=r"format version 99.*Upgrade"):
        load_agent(saved)
    (saved / CARD_FILE).write_text(json.dumps(card))

    weights = (saved / WEIGHTS_FILE).read_bytes()
    (saved / WEIGHTS_FILE).write_bytes(weights[:-10])
    with pytest.raises(CheckpointError, match=r"weights\.safetensors.*truncated"):
        load_agent(saved)
    (saved / WEIGHTS_FILE).unlink()
    with pytest.raises(CheckpointError, match=r"weights\.safetensors is missing"):
        load_agent(saved)


def test_a_card_that_builds_no_agent_is_one_clear_error(saved: Path) -> None:
    card = json.loads((saved / "card.json").read_text())
    card["modules"]["actor"]["hidden_dim"] = 3
    (saved / "card.json").write_text(json.dumps(card))
    with pytest.raises(CheckpointError, match="no agent that can be rebuilt"):
        load_agent(saved)


def test_a_snapshot_shares_a_frozen_encoder_and_copies_one_that_learns() -> None:
    for trains_encoder in (False, True):
        agent = make_agent()
        agent.trains_encoder = trains_encoder
        snapshot, action = agent.snapshot(), agent(observation())
        assert (snapshot.encoder is agent.encoder) is not trains_encoder
        assert set(snapshot.state_dict()) == ({"actor", "encoder"} if trains_encoder else {"actor"})
        with torch.no_grad():
            trained = [*agent.actor.parameters(), *(agent.encoder.parameters() if trains_encoder else [])]
            for parameter in trained:
                parameter.add_(0.5)
        assert not torch.equal(agent(observation()), action)
        assert torch.equal(snapshot(observation()), action)
        agent.load_state_dict(snapshot.state_dict())
        assert torch.equal(agent(observation()), action)


def test_an_agent_with_a_fixed_skill_comes_back_with_it(tmp_path: Path) -> None:
    torch.manual_seed(0)
    encoder = PixelEncoder(**ENCODER)
    actor = DeterministicActor(encoder.feature_dim, 3, skill_dim=4, hidden_dim=8)
    agent = PixelAgent(encoder, FixedSkillActor(actor, 2))
    loaded, card = load_agent(save_agent(tmp_path / "agent", agent, card={"task": "toy"}))
    assert torch.equal(loaded(observation()), agent(observation()))
    assert (card["modules"]["actor"]["skill"], loaded.actor.skill) == (2, 2)
    assert not torch.equal(
        agent(observation()), PixelAgent(encoder, FixedSkillActor(actor, 1))(observation())
    )


def test_agents_of_before_there_were_other_actors_still_load(saved: Path) -> None:
    card = json.loads((saved / CARD_FILE).read_text())
    del card["classes"], card["modules"]["actor"]["has_tanh"]
    (saved / CARD_FILE).write_text(json.dumps(card))
    agent, _ = load_agent(saved)
    assert torch.equal(agent(observation()), make_agent()(observation()))

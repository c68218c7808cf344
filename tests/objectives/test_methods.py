"""The table of methods: the papers' numbers, methods of one's own, and how a loss finds its row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from loss_cases import proto, small_encoder
from torch import nn
from torchrl.objectives import LossModule

from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.modules import PixelEncoder
from crptpro.objectives import (
    ATCLoss,
    BeCLLoss,
    Exploration,
    ProtoLoss,
    SimCLRLoss,
    get_method,
    method_names,
    method_of,
    register_method,
)


class OwnLoss(LossModule):
    def __init__(self, encoder: torch.nn.Module) -> None:
        super().__init__()
        self.encoder = encoder


def numbers(name: str) -> tuple:
    row = get_method(name)
    return (row.updates, row.batch_size, row.learning_rate, row.encoder_tau, row.schedule, row.grad_clip)


def test_every_method_of_the_paper_has_its_name() -> None:
    trained = {"crptpro", "atc", "apt-c", "apt-s", "proto-rl-c", "proto-rl-s", "becl"}
    assert set(method_names()) == trained
    presets = {"crptpro-no-bonus", "crptpro-fast", "crptpro-finetune", "released-code", "atc-native"}
    untrained = {"drq", "random-encoder", "random-encoder-standardised"}
    assert set(method_names(presets=True)) == trained | presets | untrained
    assert all(get_method(name).is_builtin for name in method_names(presets=True))


def test_passive_methods_have_their_papers_numbers() -> None:
    assert numbers("crptpro") == (50_000, 512, 1e-4, 0.05, "constant", None)
    assert numbers("released-code") == (49_998, 512, 1e-4, 0.05, "constant", None)
    assert numbers("atc") == (50_000, 512, 1e-3, 0.01, "warmup_cosine", 10.0)
    assert get_method("atc").warmup_updates == 1_000
    assert numbers("atc-native")[1] == 256
    native = get_method("atc-native").build_encoder()
    assert (native.feature_map_shape, native.config["init"]) == ((32, 7, 7), "kaiming")
    assert get_method("crptpro").build_encoder().config == PixelEncoder().config
    tuned = get_method("crptpro-finetune")
    assert (tuned.starts_from, tuned.updates) == ("crptpro", 2_000)
    fast = get_method("crptpro-fast")  # crptpro, but for its learning rate and the temperature of its targets
    loss = fast.build(small_encoder(), num_prototypes=8, latent_dim=4, hidden_dim=7)
    assert (float(loss.assignment_temperature), float(loss.temperature)) == (0.05, 0.1)
    usual = {"name": "crptpro", "learning_rate": 1e-4, "loss_options": {}, "is_preset": False}
    assert replace(fast, **usual) == get_method("crptpro")


@pytest.mark.parametrize(
    ("name", "loss_class", "updates", "env_steps", "is_single_domain", "transfers_actor"),
    [
        ("apt-c", SimCLRLoss, 50_000, 200_000, False, False),
        ("apt-s", SimCLRLoss, 125_000, 500_000, True, False),
        ("proto-rl-c", ProtoLoss, 50_000, 200_000, False, False),
        ("proto-rl-s", ProtoLoss, 125_000, 500_000, True, True),
        ("becl", BeCLLoss, 150_000, 200_000, False, False),
    ],
)
def test_active_methods_spend_their_budget(
    name: str, loss_class: type, updates: int, env_steps: int, is_single_domain: bool, transfers_actor: bool
) -> None:
    row = get_method(name)
    explores = row.exploration
    assert row.loss_class is loss_class
    assert numbers(name) == (updates, 512, 1e-4, 0.05 if loss_class is ProtoLoss else None, "constant", None)
    assert (explores.env_steps, explores.replay_capacity) == (env_steps, 100_000)
    assert (explores.is_single_domain, explores.transfers_actor) == (is_single_domain, transfers_actor)
    # Action repeat 2: both budgets of the paper are spent at the same time.
    assert env_steps // 2 // explores.encoder_update_interval * explores.encoder_updates_each == updates


def test_how_each_active_method_explores() -> None:
    assert get_method("proto-rl-c").exploration == Exploration(reward="prototype", agent="rad-sac")
    assert get_method("proto-rl-c").build(small_encoder(), num_prototypes=8).intr_loss_coef == 0
    apt = get_method("apt-c").exploration
    assert (apt.reward, apt.agent, apt.n_step) == ("particle", "averaged-sac", 1)
    becl = get_method("becl").exploration
    assert (becl.reward, becl.agent) == ("skill-contrast", "skill-ddpg")
    assert (becl.n_step, becl.skill_dim, becl.skill_agent_steps) == (3, 16, 50)
    assert (becl.agent_update_interval, becl.random_agent_steps) == (2, 2_000)
    assert get_method("becl").build_encoder(3, 20).pixel_offset == 0.5


@pytest.mark.parametrize(
    ("act", "error", "message"),
    [
        (lambda: get_method("crtpro"), UnknownNameError, "Did you mean crptpro"),
        (lambda: get_method("zzz"), UnknownNameError, "released-code"),
        (lambda: get_method("drq").build(small_encoder()), CRPTproError, "'drq' pre-trains nothing"),
        (
            lambda: get_method("apt-c").build(small_encoder(), intr_loss_coef=0.1),
            ValueError,
            r"'apt-c' has no option intr_loss_coef; it has .*temperature",
        ),
        (lambda: register_method("atc", ATCLoss, batch_size=256), ValueError, "'atc' is a method of the library"),
        (lambda: register_method("drq", OwnLoss), ValueError, "'drq' is a method of the library; choose another name"),
        (lambda: register_method("typo", OwnLoss, learn_rate=1.0), TypeError, "learn_rate"),
        (lambda: register_method("x", OwnLoss, starts_from="crptpro"), ValueError, "must pre-train its own encoder"),
        (lambda: Exploration(skill_dim=1), ValueError, "`skill_dim` must be at least 2"),
        (lambda: Exploration(agent="sac"), ValueError, "`agent` must be one of rad-sac, averaged-sac, skill-ddpg, got"),
        (lambda: Exploration(reward="prototypes"), ValueError, "`reward` must be one of prototype, particle, skill-co"),
        (lambda: Exploration(skill_dim=4), ValueError, "skill-ddpg, and no other, needs `skill_dim`"),
        (lambda: Exploration(agent="skill-ddpg"), ValueError, "skill-ddpg, and no other, needs `skill_dim`"),
        (lambda: Exploration(reward="skill-contrast"), ValueError, "skill-contrast needs both"),
        (
            lambda: register_method("x", OwnLoss, downstream={"learning_rate": 1e-3, "queue_size": 1_000}),
            ValueError,
            "downstream settings env_steps, .*, not queue_size",
        ),
        (lambda: register_method("x", OwnLoss, encoder_tau=1.5), ValueError, "`encoder_tau` must be at most"),
        (lambda: register_method("x", OwnLoss, schedule="cosine"), ValueError, "`schedule` must be 'constant"),
    ],
)
def test_names_options_and_numbers_that_cannot_be_are_refused_with_a_remedy(act, error, message: str) -> None:
    with pytest.raises(error, match=message):
        act()


def test_options_override_those_of_the_method_and_the_loss_remembers_its_name() -> None:
    loss = get_method("released-code").build(small_encoder(), num_prototypes=8, latent_dim=4)
    assert loss.predictor.config == {"latent_dim": 4, "hidden_dim": 512}
    assert method_of(loss) is get_method("released-code")
    assert method_of(proto()) is get_method("crptpro")
    other = get_method("released-code").build(small_encoder(), num_prototypes=8, latent_dim=4, hidden_dim=7)
    assert other.predictor.config["hidden_dim"] == 7
    assert method_of(ATCLoss(small_encoder(), latent_dim=4)) is get_method("atc")


def test_a_method_of_ones_own_is_found_by_name_and_class() -> None:
    row = register_method("own", OwnLoss, updates=np.int64(10), encoder_tau=None)
    assert "own" in method_names()
    assert not row.is_builtin
    assert type(row.updates) is int
    assert method_of(get_method("own").build(small_encoder())) is row

    class Derived(OwnLoss):
        pass

    found = method_of(Derived(small_encoder()))
    assert (found.name, found.updates) == ("Derived", 10)


def test_a_notebook_cell_that_defines_and_registers_a_method_can_be_run_again() -> None:
    class OwnLoss(LossModule):
        """As a second run of the cell defines it: a class of the same name, but another object."""

    first = register_method("own", globals()["OwnLoss"], updates=10)
    second = register_method("own", OwnLoss, updates=20)
    assert get_method("own") is second is not first
    assert (second.loss_class, second.updates) == (OwnLoss, 20)


def test_a_loss_built_by_hand_is_not_named_after_a_method_that_explores() -> None:
    row = method_of(SimCLRLoss(small_encoder(), latent_dim=4))
    assert (row.name, row.exploration, row.encoder_tau) == ("SimCLRLoss", None, None)
    register_method("own", OwnLoss, exploration=Exploration())
    assert method_of(OwnLoss(small_encoder())).name == "OwnLoss"
    assert method_of(get_method("own").build(small_encoder())).name == "own"


@pytest.mark.filterwarnings("ignore:The name")
def test_a_loss_without_a_method_is_trained_by_crptpros_numbers_with_targets_where_it_has_them() -> None:
    row = method_of(OwnLoss(small_encoder()))
    assert (row.name, row.updates, row.encoder_tau) == ("OwnLoss", 50_000, None)

    class WithTargets(SimCLRLoss):
        def __init__(self, encoder: PixelEncoder) -> None:
            super().__init__(encoder, latent_dim=4)
            self.convert_to_functional(nn.Linear(2, 2), "extra", create_target_params=True)

    assert method_of(WithTargets(small_encoder())).encoder_tau == 0.05

"""Methods by name, and the defaults of losses that have none."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from loss_cases import proto, small_encoder
from torch import nn
from torchrl.objectives import LossModule

from crptpro.errors import UnknownNameError
from crptpro.modules import PixelEncoder
from crptpro.objectives import (
    ATCLoss,
    BeCLLoss,
    ExplorationDefaults,
    ProtoLoss,
    SimCLRLoss,
    get_method,
    method_defaults,
    method_name_of,
    methods,
    register_method,
)
from crptpro.objectives import registry as registry_module
from crptpro.objectives.registry import MethodDefaults


@pytest.fixture(autouse=True)
def _own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry_module, "_METHODS", dict(registry_module._METHODS))


class OwnLoss(LossModule):
    def __init__(self, encoder: torch.nn.Module) -> None:
        super().__init__()
        self.encoder = encoder


def test_crptpro_has_the_papers_settings() -> None:
    method = get_method("crptpro")
    assert method.loss_class is ProtoLoss
    assert method.defaults == MethodDefaults(
        updates=50_000, batch_size=512, lr=1e-4, betas=(0.9, 0.999), encoder_tau=0.05, schedule="constant"
    )
    assert method_defaults(proto()) is method_defaults(ProtoLoss) is method.defaults


def test_released_code_is_a_preset_with_its_own_width_and_updates() -> None:
    assert "released-code" not in methods()
    assert "released-code" in methods(presets=True)
    loss = get_method("released-code").build(small_encoder(), num_prototypes=8, latent_dim=4)
    assert loss.predictor.config == {"latent_dim": 4, "hidden_dim": 512}
    assert method_defaults(loss).updates == 49_998
    assert method_defaults(type(loss)).updates == 50_000


def test_crptpro_fast_is_crptpro_but_for_its_learning_rate_and_the_temperature_of_its_targets() -> None:
    assert "crptpro-fast" in set(methods(presets=True)) - set(methods())
    fast, usual = get_method("crptpro-fast"), get_method("crptpro")
    loss = fast.build(small_encoder(), num_prototypes=8, latent_dim=4, hidden_dim=7)
    assert (float(loss.assignment_temperature), float(loss.temperature)) == (0.05, 0.1)
    assert fast.defaults == replace(usual.defaults, lr=3e-4)
    assert fast.describe() | {"loss_options": {}, "defaults": None} == usual.describe() | {"defaults": None}


def test_options_override_those_of_the_preset() -> None:
    loss = get_method("released-code").build(small_encoder(), num_prototypes=8, latent_dim=4, hidden_dim=7)
    assert loss.predictor.config["hidden_dim"] == 7


def test_unknown_method_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean crptpro"):
        get_method("crtpro")
    with pytest.raises(UnknownNameError, match="released-code"):
        get_method("zzz")


def test_a_users_method_is_registered_and_found_by_name_and_class() -> None:
    defaults = MethodDefaults(updates=10, encoder_tau=None)
    register_method("own", OwnLoss, defaults)
    assert "own" in methods()
    assert method_defaults(get_method("own").build(small_encoder())) is defaults

    class Derived(OwnLoss):
        pass

    assert method_defaults(Derived(small_encoder())) is defaults
    with pytest.raises(ValueError, match="'own' is already registered for OwnLoss"):
        register_method("own", ProtoLoss)


def test_a_loss_built_by_hand_is_named_by_the_first_registered_method_of_its_very_class() -> None:
    register_method("ablation", ProtoLoss, loss_options={"intr_loss_coef": 0.0})
    assert method_name_of(proto()) == "crptpro"
    assert method_name_of(get_method("ablation").build(small_encoder(), num_prototypes=8)) == "ablation"

    class Derived(ProtoLoss):
        pass

    assert method_name_of(Derived(small_encoder(), num_prototypes=8)) == "Derived"


def test_an_unregistered_loss_gets_generic_defaults_and_no_target_rate_without_targets() -> None:
    assert method_defaults(OwnLoss(small_encoder())) == MethodDefaults(encoder_tau=None)
    assert method_defaults(OwnLoss) == MethodDefaults()


# The paper's methods ----------------------------------------------------------------------------------------------


def test_targets_added_to_a_method_without_any_move_at_the_generic_rate() -> None:
    class WithTargets(SimCLRLoss):
        def __init__(self, encoder: PixelEncoder) -> None:
            super().__init__(encoder, latent_dim=4)
            self.convert_to_functional(nn.Linear(2, 2), "extra", create_target_params=True)

    encoder = PixelEncoder(3, channels=(4,), strides=(2,), image_size=16)
    assert method_defaults(SimCLRLoss(encoder, latent_dim=4)).encoder_tau is None
    assert method_defaults(WithTargets(encoder)).encoder_tau == 0.05


def test_every_pretraining_method_of_the_paper_has_its_name() -> None:
    assert {"crptpro", "atc", "apt-c", "apt-s", "proto-rl-c", "proto-rl-s", "becl"} <= set(methods())
    assert {"released-code", "atc-native"} <= set(methods(presets=True)) - set(methods())


def test_atc_has_its_own_schedule_on_the_shared_trunk_and_budget() -> None:
    method = get_method("atc")
    assert method.loss_class is ATCLoss
    assert method.defaults == MethodDefaults(
        updates=50_000, batch_size=512, lr=1e-3, encoder_tau=0.01,
        schedule="warmup_cosine", warmup_updates=1_000, grad_clip=10.0,
    )  # fmt: skip
    assert method.build_encoder().feature_dim == 39_200
    assert method.exploration is None


def test_atc_native_has_its_own_encoder_and_batch() -> None:
    method = get_method("atc-native")
    assert (method.defaults.batch_size, method.defaults.lr) == (256, 1e-3)
    encoder = method.build_encoder()
    assert encoder.feature_map_shape == (32, 7, 7)
    assert encoder.config["init"] == "kaiming"
    assert method_defaults(method.build(encoder)).batch_size == 256
    assert method_defaults(ATCLoss) is get_method("atc").defaults


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
    method = get_method(name)
    explores = method.exploration
    assert method.loss_class is loss_class
    assert (method.defaults.updates, method.defaults.batch_size, method.defaults.lr) == (updates, 512, 1e-4)
    assert method.defaults.encoder_tau == (0.05 if loss_class is ProtoLoss else None)
    assert explores.env_steps == env_steps
    assert (explores.is_single_domain, explores.transfers_actor) == (is_single_domain, transfers_actor)
    assert explores.replay_capacity == 100_000
    # Action repeat 2: both budgets of the paper are spent at the same time.
    assert env_steps // 2 // explores.encoder_update_interval * explores.encoder_updates_each == updates


def test_how_each_active_method_explores() -> None:
    assert get_method("proto-rl-c").exploration == ExplorationDefaults(reward="prototype", agent="rad-sac")
    assert get_method("proto-rl-c").build(small_encoder(), num_prototypes=8).intr_loss_coef == 0
    apt = get_method("apt-c").exploration
    assert (apt.reward, apt.agent, apt.n_step) == ("particle", "averaged-sac", 1)
    becl = get_method("becl").exploration
    assert (becl.reward, becl.agent) == ("skill-contrast", "skill-ddpg")
    assert (becl.n_step, becl.skill_dim, becl.skill_agent_steps) == (3, 16, 50)
    assert (becl.agent_update_interval, becl.random_agent_steps) == (2, 2_000)
    assert get_method("crptpro").exploration is None


def test_becls_encoder_sees_centred_pixels() -> None:
    encoder = get_method("becl").build_encoder(3, 20)
    assert isinstance(encoder, PixelEncoder)
    assert (encoder.in_channels, encoder.image_size, encoder.pixel_offset) == (3, 20, 0.5)
    assert get_method("crptpro").build_encoder().config == PixelEncoder().config


def test_an_option_that_the_loss_lacks_is_named() -> None:
    with pytest.raises(ValueError, match=r"'apt-c' has no option intr_loss_coef; it has .*temperature"):
        get_method("apt-c").build(small_encoder(), intr_loss_coef=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"env_steps": 0}, "env_steps must be at least 1, got 0"),
        ({"encoder_update_interval": 0}, "encoder_update_interval must be at least 1"),
        ({"random_agent_steps": -1}, "random_agent_steps must not be negative, got -1"),
        ({"skill_dim": 1}, "skill_dim must be at least 2"),
    ],
)
def test_impossible_exploration_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ExplorationDefaults(**options)

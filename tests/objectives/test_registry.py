"""Methods by name, and the defaults of losses that have none."""

from __future__ import annotations

import pytest
import torch
from loss_cases import proto, small_encoder
from torchrl.objectives import LossModule

from crptpro.errors import UnknownNameError
from crptpro.objectives import ProtoLoss, get_method, method_defaults, methods, register_method
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


def test_an_unregistered_loss_gets_generic_defaults_and_no_target_rate_without_targets() -> None:
    assert method_defaults(OwnLoss(small_encoder())) == MethodDefaults(encoder_tau=None)
    assert method_defaults(OwnLoss) == MethodDefaults()

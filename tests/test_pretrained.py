from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import LossModule

from crptpro import artifact
from crptpro.errors import DiskSpaceError, PretrainedError
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import finetune, load_pretrained, random_pretrained, rebuild_loss, save_pretrained
from crptpro.training import pretrain
from crptpro.training.agent import save_agent

TINY: dict[str, Any] = {"channels": (4, 4), "strides": (2, 1), "image_size": 16}


def make_dataset(seed: int) -> ReplayBuffer:
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.randint(0, 256, (40, 9, 16, 16), dtype=torch.uint8, generator=generator)
    buffer = ReplayBuffer(storage=LazyTensorStorage(40), batch_size=8)
    buffer.extend(TensorDict({"pixels": pixels, "next": {"pixels": pixels.roll(1, -1)}}, [40]))
    return buffer


def make_loss(seed: int = 0, **options: Any) -> ProtoLoss:
    torch.manual_seed(seed)
    return ProtoLoss(
        PixelEncoder(**TINY), **{"num_prototypes": 8, "latent_dim": 8, "hidden_dim": 16, **options}
    )


def train(loss: LossModule, updates: int = 5) -> Any:
    settings: dict[str, Any] = {
        "batch_size": 8,
        "learning_rate": 1e-3,
        "precision": "fp32",
        "progress": False,
    }
    return pretrain(loss, {"walker": make_dataset(0)}, updates=updates, **settings)


@pytest.fixture(scope="module")
def trained() -> ProtoLoss:
    loss = make_loss(assignment_temperature=0.05)
    train(loss)
    return loss


@pytest.fixture
def saved(trained: ProtoLoss, tmp_path: Path) -> Path:
    return save_pretrained(trained, tmp_path / "encoder", extra_card={"note": "made by a test"})


def test_every_network_comes_back_bit_equal(trained: ProtoLoss, saved: Path) -> None:
    loaded = load_pretrained(saved)
    for role in ("encoder", "projector", "predictor", "prototypes"):
        one, two = getattr(trained, role).state_dict(), getattr(loaded, role).state_dict()
        assert one.keys() == two.keys()
        assert all(torch.equal(one[key], two[key]) for key in one)
    targets = trained.target_state()
    for role, module in (("encoder", loaded.target_encoder), ("projector", loaded.target_projector)):
        assert all(torch.equal(targets[role][key], value) for key, value in module.state_dict().items())
        assert not all(
            torch.equal(v, getattr(loaded, role).state_dict()[k]) for k, v in targets[role].items()
        )
    pixels = torch.randint(0, 256, (5, 9, 16, 16), dtype=torch.uint8)
    assert torch.equal(trained.encoder(pixels), loaded.encoder(pixels))
    assert not any(p.requires_grad for p in loaded.encoder.parameters())


def test_the_card_says_how_it_was_made(saved: Path) -> None:
    card = load_pretrained(saved).card
    assert card["method"] == "crptpro"
    assert card["note"] == "made by a test"
    assert card["pixels"] == {
        "image_size": 16, "in_channels": 9, "frame_stack": 3, "pixel_scale": 1 / 255, "pixel_offset": 0.0,
    }  # fmt: skip
    assert card["loss"]["config"]["assignment_temperature"] == 0.05
    assert card["training"]["updates"] == 5
    assert card["training"]["datasets"] == [{"domain": "walker", "transitions": 40}]
    assert card["training"]["collapse"]["verdict"] in ("learning", "dead")
    assert {"torch", "torchrl"} <= set(card["versions"])
    assert len(card["weights_sha256"]) == 64


def test_an_artifact_can_be_replaced_and_a_failed_write_keeps_the_old(
    trained: ProtoLoss, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = load_pretrained(saved).identity()

    def full(*arguments: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(artifact.os, "fsync", full)
    with pytest.raises(DiskSpaceError, match="disk is full"):
        save_pretrained(make_loss(1), saved)
    monkeypatch.undo()
    assert load_pretrained(saved).identity() == before
    assert [child.name for child in saved.parent.iterdir()] == ["encoder"]
    save_pretrained(make_loss(1), saved)
    assert load_pretrained(saved).identity() != before


def test_another_directory_is_never_replaced(trained: ProtoLoss, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "pretrain.csv").write_text("precious")
    with pytest.raises(PretrainedError, match="not replaced"):
        save_pretrained(trained, tmp_path / "run")
    assert (tmp_path / "run" / "pretrain.csv").read_text() == "precious"


def edit_card(path: Path, edit: Any) -> None:
    card = json.loads((path / "card.json").read_text())
    edit(card)
    (path / "card.json").write_text(json.dumps(card))


def edit_weights(path: Path, edit: Any) -> None:
    """Change the weights and the card's checksum with them."""
    tensors = load_file(path / "weights.safetensors")
    tensors = {key: value.clone() for key, value in tensors.items()}
    edit(tensors)
    save_file(tensors, path / "weights.safetensors")
    digest = artifact._sha256(path / "weights.safetensors")
    edit_card(path, lambda card: card.update(weights_sha256=digest))


def test_a_flipped_bit_is_found(saved: Path) -> None:
    content = bytearray((saved / "weights.safetensors").read_bytes())
    content[-1] ^= 1
    (saved / "weights.safetensors").write_bytes(content)
    with pytest.raises(PretrainedError, match="truncated, damaged or replaced"):
        load_pretrained(saved)


def test_truncated_weights_are_found(saved: Path) -> None:
    content = (saved / "weights.safetensors").read_bytes()
    (saved / "weights.safetensors").write_bytes(content[:-100])
    with pytest.raises(PretrainedError, match="truncated"):
        load_pretrained(saved)


@pytest.mark.parametrize("name", ["weights.safetensors", "card.json"])
def test_a_missing_file_is_named(saved: Path, name: str) -> None:
    (saved / name).unlink()
    with pytest.raises(PretrainedError, match=name.replace(".", r"\.")):
        load_pretrained(saved)


def test_a_missing_directory_is_named(tmp_path: Path) -> None:
    with pytest.raises(PretrainedError, match="nowhere"):
        load_pretrained(tmp_path / "nowhere")


def test_the_run_directory_above_is_refused_with_a_hint(saved: Path) -> None:
    with pytest.raises(PretrainedError, match=r"Did you mean .*encoder\?"):
        load_pretrained(saved.parent)


def test_shapes_are_checked_against_the_card(saved: Path) -> None:
    edit_card(saved, lambda card: card["modules"]["prototypes"]["config"].update(num_prototypes=9))
    with pytest.raises(
        PretrainedError, match=r"prototypes\.weight has shape \(8, 8\), its card says \(9, 8\)"
    ):
        load_pretrained(saved)


def test_missing_and_unknown_tensors_are_named(saved: Path) -> None:
    edit_weights(saved, lambda tensors: tensors.update({"intruder.weight": torch.zeros(1)}))
    with pytest.raises(PretrainedError, match=r"intruder\.weight"):
        load_pretrained(saved)
    edit_weights(
        saved, lambda tensors: [tensors.pop("intruder.weight"), tensors.pop("projector.linear.bias")]
    )
    with pytest.raises(PretrainedError, match=r"lacks the tensor projector\.linear\.bias"):
        load_pretrained(saved)


def test_an_agent_is_no_pretrained_encoder(tmp_path: Path, trained: ProtoLoss) -> None:
    from crptpro.modules import SquashedGaussianActor
    from crptpro.training.agent import PixelAgent

    actor = SquashedGaussianActor(trained.encoder.feature_dim, 2, hidden_dim=8)
    save_agent(tmp_path / "agent", PixelAgent(trained.encoder, actor), card={"task": "walker_run"})
    with pytest.raises(PretrainedError, match=r"actor \(and critic\) of a downstream run"):
        load_pretrained(tmp_path / "agent")


def test_actor_and_critic_alone_are_refused_by_name(tmp_path: Path) -> None:
    networks = {"actor": nn.Linear(2, 2), "critic": nn.Linear(2, 2)}
    card = {"modules": {"actor": {}, "critic": {}}}
    artifact.write_artifact(tmp_path / "x", networks, card=card, format_name="crptpro-pretrained", version=1)
    with pytest.raises(PretrainedError, match="holds actor, critic, but no encoder"):
        load_pretrained(tmp_path / "x")


def test_loose_weights_without_a_card_are_refused(tmp_path: Path) -> None:
    torch.save(nn.Linear(2, 2).state_dict(), tmp_path / "actor.pt")
    with pytest.raises(PretrainedError, match=r"no card\.json among its files \(actor\.pt\)"):
        load_pretrained(tmp_path)


def test_a_newer_format_is_refused(saved: Path) -> None:
    edit_card(saved, lambda card: card.update(version=99))
    with pytest.raises(PretrainedError, match="version 99"):
        load_pretrained(saved)


def test_what_does_not_fit_is_named_with_both_values(saved: Path) -> None:
    loaded = load_pretrained(saved, expect={"image_size": 16, "frame_stack": 3, "prototypes": True})
    assert loaded.require(pixel_scale=1 / 255, pixel_offset=0.0) is loaded
    with pytest.raises(PretrainedError, match=r"image_size 16, not 84.*frame_stack 3, not 1"):
        loaded.require(image_size=84, frame_stack=1)
    with pytest.raises(PretrainedError, match=r"pixel_offset 0\.0, not 0\.5"):
        load_pretrained(saved, expect={"pixel_offset": 0.5})
    with pytest.raises(PretrainedError, match="no prototypes"):
        random_pretrained(**TINY).require(prototypes=True)


def test_the_random_control_depends_on_its_seed_alone() -> None:
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    one, same, other = (random_pretrained(seed, **TINY) for seed in (0, 0, 1))
    assert torch.equal(torch.rand(1), expected)
    assert one.identity() == same.identity() != other.identity()
    assert one.method == "random-encoder"
    assert one.prototypes is None
    assert not any(p.requires_grad for p in one.encoder.parameters())


def test_the_random_control_can_be_kept(tmp_path: Path) -> None:
    control = random_pretrained(3, **TINY)
    loaded = load_pretrained(save_pretrained(control, tmp_path / "random"))
    assert loaded.method == "random-encoder"
    assert torch.equal(loaded.encoder.convs[0].weight, control.encoder.convs[0].weight)


def test_a_rebuilt_loss_is_the_one_that_was_saved(trained: ProtoLoss, saved: Path) -> None:
    loss = rebuild_loss(load_pretrained(saved))
    one, two = trained.state_dict(), loss.state_dict()
    assert one.keys() == two.keys()
    assert all(torch.equal(one[key], two[key]) for key in one)
    assert all(p.requires_grad for p in loss.parameters())


def test_finetuning_starts_from_the_artifact_with_its_targets_and_fresh_adam(
    trained: ProtoLoss, saved: Path
) -> None:
    options: dict[str, Any] = {
        "batch_size": 8,
        "learning_rate": 1e-12,
        "precision": "fp32",
        "progress": False,
    }
    pretrained = load_pretrained(saved)
    loss, result = finetune(pretrained, make_dataset(1), updates=1, **options)
    target, online = pretrained.target_encoder.convs[0].weight, pretrained.encoder.convs[0].weight
    expected = target + 0.05 * (online - target)
    assert torch.allclose(loss.target_state()["encoder"]["convs.0.weight"], expected, atol=1e-7)
    assert torch.allclose(loss.encoder.convs[0].weight, online, atol=1e-7)
    assert not pretrained.encoder.convs[0].weight.requires_grad
    assert result.updates == 1
    assert loss.training_record["started_from"] == pretrained.identity()
    assert loss.training_record["previous_training"]["updates"] == 5


def test_finetuning_resumes_only_from_the_same_artifact(saved: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "batch_size": 8,
        "precision": "fp32",
        "progress": False,
        "run_dir": tmp_path / "run",
    }
    finetune(saved, make_dataset(1), updates=2, **options)
    assert finetune(saved, make_dataset(1), updates=4, **options)[1].resumed_from == 2
    other = save_pretrained(make_loss(9), tmp_path / "other")
    with pytest.raises(Exception, match="started_from"):
        finetune(other, make_dataset(1), updates=4, **options)


def test_an_unregistered_method_cannot_be_finetuned(saved: Path) -> None:
    edit_card(saved, lambda card: card.update(method="somebody-elses"))
    with pytest.raises(PretrainedError, match="no registered method"):
        finetune(saved, make_dataset(0), updates=1)


class OwnLoss(LossModule):
    """A user's loss around a wrapped encoder, with targets and a head of its own."""

    encoder: TensorDictModule
    encoder_params: Any
    target_encoder_params: Any

    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        module = TensorDictModule(encoder, in_keys=["pixels"], out_keys=["features"])
        self.convert_to_functional(module, "encoder", create_target_params=True)
        self.head = nn.Linear(3, 3)

    def forward(self, tensordict: Any) -> Any:
        raise NotImplementedError


def test_a_users_own_loss_is_saved_with_encoder_targets_and_the_rest(tmp_path: Path) -> None:
    loss = OwnLoss(PixelEncoder(**TINY))
    loss.target_encoder_params.data.apply_(lambda value: value.fill_(3.0))
    loaded = load_pretrained(save_pretrained(loss, tmp_path / "own"))
    assert loaded.method == "OwnLoss"
    assert loaded.projector is None
    state = loss.encoder.module.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in loaded.encoder.state_dict().items())
    assert all((value == 3.0).all() for value in loaded.target_encoder.state_dict().values())
    assert torch.equal(loaded.rest["head.weight"], loss.head.weight)


class OwnEncoder(nn.Module):
    def __init__(self, width: int = 3, image_size: int = 16, in_channels: int = 9) -> None:
        super().__init__()
        self.linear = nn.Linear(1, width)
        self.config = {"width": width, "image_size": image_size, "in_channels": in_channels}


def test_an_own_encoder_needs_its_class_to_come_back(tmp_path: Path) -> None:
    loss = OwnLoss(OwnEncoder())
    path = save_pretrained(loss, tmp_path / "own")
    with pytest.raises(PretrainedError, match=r"is a 'OwnEncoder'.*classes="):
        load_pretrained(path)
    loaded = load_pretrained(path, classes={"OwnEncoder": OwnEncoder})
    assert torch.equal(loaded.encoder.linear.weight, loss.encoder.module.linear.weight)


def test_a_loss_without_an_encoder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PretrainedError, match=r"has no `\.encoder`"):
        save_pretrained(nn.Linear(1, 1), tmp_path / "x")
    assert not (tmp_path / "x").exists()

"""What a pre-training leaves: written, read back, refused where it does not fit, trained further."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import toy_runs
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule
from toy_env import random_episode, write_dataset

from crptpro import pretrained
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError, PretrainedError, UnknownNameError
from crptpro.modules import PixelEncoder, SquashedGaussianActor, register_network
from crptpro.objectives import BeCLLoss, SimCLRLoss
from crptpro.pretrained import Pretrained, load_pretrained, random_pretrained, save_pretrained, shipped_encoders
from crptpro.training import PretrainResult, finetune, pretrain, train_downstream
from crptpro.transforms import RandomShift

TINY: dict[str, Any] = {"channels": (4, 4), "strides": (2, 1), "image_size": 16}
PIXELS = torch.randint(0, 256, (5, 9, 16, 16), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
OPTIONS: dict[str, Any] = {"batch_size": 8, "precision": "fp32", "progress": False}


make_loss = partial(toy_runs.make_loss, channels=9)


def states(source: Any, *roles: str) -> dict[str, Tensor]:
    return {f"{role}.{k}": v for role in roles for k, v in getattr(source, role).state_dict().items()}


def all_equal(one: dict[str, Tensor], two: dict[str, Tensor]) -> bool:
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "walker"
    return write_dataset(path, [random_episode(40, size=16)], domain="walker", task="walker_run")


@pytest.fixture(scope="module")
def result(data: Path) -> PretrainResult:
    return pretrain(make_loss(assignment_temperature=0.05), data, updates=5, learning_rate=1e-3, **OPTIONS)


@pytest.fixture(scope="module")
def kept(result: PretrainResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pretrained(result, tmp_path_factory.mktemp("kept") / "encoder")


@pytest.fixture
def saved(kept: Path, tmp_path: Path) -> Path:
    """One that a test may damage."""
    return Path(shutil.copytree(kept, tmp_path / "encoder"))


# --- round trips ----------------------------------------------------------------------------------------------------


def test_every_network_comes_back_bit_equal_and_reading_draws_nothing(result: PretrainResult, kept: Path) -> None:
    before = torch.get_rng_state()
    loaded = load_pretrained(kept)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(loaded.encoder(PIXELS), result.loss.encoder(PIXELS))
    assert not any(p.requires_grad for p in loaded.encoder.parameters())
    for online, target in ((loaded.encoder, loaded.target_encoder), (loaded.projector, loaded.target_projector)):
        assert not all_equal(online.state_dict(), target.state_dict())
    loss = loaded.build_loss()
    assert all_equal(loss.state_dict(), result.loss.state_dict())
    assert all(p.requires_grad for p in loss.parameters())


def test_the_card_says_how_it_was_made(kept: Path) -> None:
    card = load_pretrained(kept).card
    assert card["method"] == "crptpro"
    assert card["pixels"] == {
        "image_size": 16, "in_channels": 9, "frame_stack": 3, "pixel_scale": 1 / 255, "pixel_offset": 0.0,
    }  # fmt: skip
    assert card["loss"]["config"]["assignment_temperature"] == 0.05
    assert card["training"]["updates"] == 5
    assert card["training"]["datasets"] == [{
        "domain": "walker", "task": "walker_run", "transitions": 40, "episodes": 1, "action_repeat": 2,
        "image_size": 16, "seed": 0, "quality": "exact", "colors": "normal",
    }]  # fmt: skip
    assert card["training"]["collapse"]["verdict"] in ("learning", "dead")
    assert {"torch", "torchrl"} <= set(card["versions"])
    assert len(card["weights_sha256"]) == 64


def test_a_result_is_saved_with_its_facts_queue_and_actor(result: PretrainResult, tmp_path: Path) -> None:
    actor = SquashedGaussianActor(result.loss.encoder.feature_dim, 2, bottleneck_dim=5, hidden_dim=8)
    given = SimpleNamespace(
        loss=result.loss, method="apt-c", training={"updates": np.int64(9)}, actor=actor, queue=torch.randn(16, 8)
    )
    loaded = load_pretrained(save_pretrained(given, tmp_path / "a"))
    assert (loaded.method, loaded.card["training"]) == ("apt-c", {"updates": 9})
    assert torch.equal(loaded.queue, given.queue)
    assert all_equal(states(loaded, "actor"), states(given, "actor"))
    again = load_pretrained(save_pretrained(loaded, tmp_path / "b"))
    assert torch.equal(again.queue, given.queue)
    assert all_equal(states(again, "actor", "target_encoder"), states(loaded, "actor", "target_encoder"))
    with pytest.raises(PretrainedError, match="neither a loss nor a pre-training result"):
        save_pretrained(SimpleNamespace(updates=3), tmp_path / "c")


def test_what_cannot_be_rebuilt_is_refused_and_the_old_artifact_kept(saved: Path) -> None:
    loss, before = make_loss(1), load_pretrained(saved).identity()
    loss.encoder.config["channels"] = (4, 5)
    with pytest.raises(PretrainedError, match=r"encoder in .* is not the PixelEncoder of its card"):
        save_pretrained(loss, saved)
    loss.encoder.config["channels"] = object()
    with pytest.raises(ValueError, match=r"PixelEncoder\.config\.channels"):
        save_pretrained(loss, saved)
    assert load_pretrained(saved).identity() == before


# --- slim, bfloat16, shipped ------------------------------------------------------------------------------------------


def test_slim_leaves_out_what_only_training_reads_and_is_named_as_what_it_comes_from(
    kept: Path, tmp_path: Path
) -> None:
    whole = load_pretrained(kept)
    slim = load_pretrained(save_pretrained(whole, tmp_path / "slim", slim=True))
    roles = ("encoder", "projector", "prototypes")
    assert all_equal(states(whole, *roles), states(slim, *roles))
    assert (slim.predictor, slim.target_encoder, slim.target_projector, slim.rest) == (None, None, None, {})
    again = load_pretrained(save_pretrained(slim, tmp_path / "slim", slim=True))
    assert again.identity() == slim.identity() == whole.identity()
    assert slim.card["training"] == whole.card["training"]
    with pytest.raises(PretrainedError, match="saved slim: it does not hold"):
        slim.build_loss()


@pytest.mark.parametrize("loss_class", [SimCLRLoss, BeCLLoss])
def test_without_prototypes_slim_keeps_the_encoder_alone(loss_class: type[LossModule], tmp_path: Path) -> None:
    loss = loss_class(PixelEncoder(**TINY))
    for slim in (False, True):
        save_pretrained(loss, tmp_path / str(slim), slim=slim)
    loaded = load_pretrained(tmp_path / "True")
    assert (loaded.projector, loaded.predictor, loaded.queue, loaded.rest) == (None, None, None, {})
    assert torch.equal(loaded.encoder(PIXELS), loss.encoder(PIXELS))
    sizes = [(tmp_path / name / "weights.safetensors").stat().st_size for name in ("False", "True")]
    assert sizes[1] < sizes[0] / 10


def test_networks_in_bfloat16_are_saved_in_half_the_size_and_loaded_as_float32(kept: Path, tmp_path: Path) -> None:
    whole, slim = load_pretrained(kept), load_pretrained(save_pretrained(load_pretrained(kept), tmp_path, slim=True))
    rounded = {k: v.bfloat16().float() for k, v in states(whole, "encoder", "prototypes").items()}
    for source in (whole, slim):
        for network in (source.encoder, source.projector, source.prototypes):
            network.bfloat16()
        for is_slim in (False, True):
            path = save_pretrained(source, tmp_path / "half", slim=is_slim)
            half = load_pretrained(path)
            assert half.encoder.convs[0].weight.dtype == torch.float32
            assert all_equal(states(half, "encoder", "prototypes"), rounded)
            assert half.identity() != load_pretrained(kept).identity()
    sizes = [(path / "weights.safetensors").stat().st_size for path in (path, tmp_path)]
    assert sizes[0] < 0.6 * sizes[1]


def test_an_artifact_whose_networks_were_changed_has_another_identity(kept: Path, tmp_path: Path) -> None:
    whole = load_pretrained(kept)
    assert whole.identity() == f"crptpro:{whole.card['weights_sha256']}"
    without = dataclasses.replace(whole, prototypes=None)
    other = dataclasses.replace(whole, encoder=PixelEncoder(**TINY))
    assert len({whole.identity(), without.identity(), other.identity()}) == 3
    assert load_pretrained(save_pretrained(without, tmp_path / "slim", slim=True)).identity() == without.identity()


def test_an_encoder_that_ships_is_loaded_by_name_and_an_unknown_name_lists_them(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pretrained, "SHIPPED", tmp_path / "package" / "encoders")
    assert shipped_encoders() == []
    with pytest.raises(PretrainedError, match=r"nowhere does not exist, and no encoder .* those that do: none"):
        load_pretrained("nowhere")
    shutil.copytree(kept, pretrained.SHIPPED / "group-a")
    (pretrained.SHIPPED / "notes").mkdir()
    assert shipped_encoders() == ["group-a"]
    assert load_pretrained("group-a").identity() == load_pretrained(kept).identity()
    with pytest.raises(PretrainedError, match="those that do: group-a"):
        load_pretrained("group-b")
    with pytest.raises(PretrainedError, match="does not exist"):
        load_pretrained("runs/group-a")  # a path
    save_pretrained(make_loss(1), "group-a")  # a directory of this name comes first
    assert load_pretrained("group-a").identity() != load_pretrained(kept).identity()


@pytest.mark.gl
def test_a_task_is_learned_on_every_encoder_that_ships() -> None:
    for name in shipped_encoders():
        learned = train_downstream(
            "finger_spin", name, env_steps=200, action_repeat=20, random_agent_steps=4, batch_size=4,
            replay_capacity=20, features="reencode", eval_episodes=1, eval_workers=0, progress=False,
        )  # fmt: skip
        before, after = (row["episode_return"] for row in learned.evaluations)
        assert 0 <= min(before, after) <= max(before, after) <= 1_000
        assert torch.equal(learned.agent.encoder.convs[0].weight, load_pretrained(name).encoder.convs[0].weight)
    assert shipped_encoders()


# --- refusals ---------------------------------------------------------------------------------------------------------


def edit_card(path: Path, edit: Any) -> None:
    card = json.loads((path / "card.json").read_text())
    edit(card)
    (path / "card.json").write_text(json.dumps(card))


@pytest.mark.parametrize(("edit", "message"), [
    (lambda card: card["modules"]["prototypes"]["config"].update(num_prototypes=9),
     r"prototypes .* is not the Prototypes of its card: [\s\S]*\[9, 8\]"),
    (lambda card: card["modules"]["prototypes"]["config"].update(colour=9), "does not describe a Prototypes: .*colour"),
    (lambda card: card["modules"].pop("prototypes"), "does not describe: prototypes"),
    (lambda card: card["modules"].update(actor=card["modules"]["projector"]),
     r"actor .* is not the Projector of its card: [\s\S]*Missing key.*linear\.bias"),
    (lambda card: card.update(modules={}), "but no encoder"),
    (lambda card: card["modules"].update(critic={}), "describes an unknown 'critic'"),
])  # fmt: skip
def test_a_card_that_does_not_describe_the_weights_is_refused(saved: Path, edit: Any, message: str) -> None:
    edit_card(saved, edit)
    with pytest.raises(PretrainedError, match=message):
        load_pretrained(saved)


def test_what_is_no_pretrained_encoder_is_named_for_what_it_is(kept: Path, tmp_path: Path) -> None:
    with pytest.raises(PretrainedError, match=r"Did you mean .*encoder\?"):
        load_pretrained(kept.parent)
    with pytest.raises(PretrainedError, match=r"has no `\.encoder`"):
        save_pretrained(nn.Linear(1, 1), tmp_path / "x")
    assert not (tmp_path / "x").exists()


# --- the random control -----------------------------------------------------------------------------------------------


def test_the_random_control_depends_on_its_seed_alone_and_can_be_kept(tmp_path: Path) -> None:
    before = torch.get_rng_state()
    one, same, other = (random_pretrained(seed, **TINY) for seed in (0, 0.0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert one.identity() == same.identity() != other.identity()
    assert one.prototypes is None
    assert not any(p.requires_grad for p in one.encoder.parameters())
    loaded = load_pretrained(save_pretrained(one, tmp_path / "random"))
    assert loaded.method == "random-encoder"
    assert all_equal(states(loaded, "encoder"), states(one, "encoder"))


@pytest.mark.parametrize("method", ["random-encoder-standardized", "crptpro"])
def test_a_control_that_does_not_exist_is_refused_with_those_that_do(method: str) -> None:
    with pytest.raises(UnknownNameError, match=rf"drq, random-encoder, random-encoder-standardised, got '{method}'"):
        random_pretrained(method=method, **TINY)


@pytest.mark.parametrize("frame_stack", [3, 2])
def test_a_standardised_control_depends_on_stored_frames_alone_names_them_and_leaves_the_dataset_as_it_is(
    data: Path, tmp_path: Path, frame_stack: int
) -> None:
    options: dict[str, Any] = {**TINY, "method": "random-encoder-standardised", "in_channels": 3 * frame_stack}
    dataset = FrameDataset.open(data, frame_stack=frame_stack)
    control = random_pretrained(datasets=[dataset], **options)
    plain = control.identity()
    (named,) = load_pretrained(save_pretrained(control, tmp_path / "control")).card["standardised_on"]
    assert (named["domain"], named["transitions"]) == ("walker", 40)
    for path in (data, str(data)):
        assert random_pretrained(datasets=path, **options).identity() == plain
    dataset.append_transform(RandomShift(pad=4, in_keys=["pixels"]))
    dataset.set_rng(torch.Generator().manual_seed(3))
    expected = FrameDataset.open(data, generator=torch.Generator().manual_seed(3)).sample(9)["index"]
    assert random_pretrained(datasets=dataset, **options).identity() == plain
    assert torch.equal(dataset.sample(9)["index"], expected)


def test_weights_in_bfloat16_have_an_identity() -> None:
    one, other = (Pretrained(PixelEncoder(**TINY).bfloat16()) for _ in range(2))
    assert one.identity() == one.identity() != other.identity()


# --- training further -------------------------------------------------------------------------------------------------


def test_finetuning_starts_from_the_artifact_with_its_targets_and_fresh_adam(kept: Path, data: Path) -> None:
    loaded = load_pretrained(kept)
    result = finetune(loaded, data, updates=1, learning_rate=1e-12, **OPTIONS)
    target, online = loaded.target_encoder.convs[0].weight, loaded.encoder.convs[0].weight
    expected = target + 0.05 * (online - target)
    found = result.loss.target_encoder_params["convs", "0", "weight"]
    assert torch.allclose(found, expected, atol=1e-7)
    assert torch.allclose(result.loss.encoder.convs[0].weight, online, atol=1e-7)
    assert not online.requires_grad
    assert result.updates == 1
    assert result.training["started_from"] == loaded.identity()
    assert result.training["previous_training"] == loaded.card["training"]
    tuned = Pretrained(loaded.encoder, card={"method": "crptpro", "training": result.training})
    assert tuned.label == "crptpro-finetune"


def test_finetuning_resumes_only_from_the_same_artifact(kept: Path, data: Path, tmp_path: Path) -> None:
    run = {**OPTIONS, "run_dir": tmp_path / "run"}
    finetune(kept, data, updates=2, **run)
    assert finetune(kept, data, updates=4, **run).resumed_from == 2
    other = save_pretrained(make_loss(9), tmp_path / "other")
    with pytest.raises(CRPTproError, match="started_from"):
        finetune(other, data, updates=4, **run)


def test_an_unregistered_method_cannot_be_finetuned(saved: Path, data: Path) -> None:
    edit_card(saved, lambda card: card.update(method="somebody-elses"))
    with pytest.raises(PretrainedError, match="not a registered method"):
        finetune(saved, data, updates=1)
    with pytest.raises(PretrainedError, match="random-encoder was not trained by a loss"):
        finetune(random_pretrained(**TINY), data, updates=1)


# --- networks of one's own --------------------------------------------------------------------------------------------


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


class OwnEncoder(nn.Module):
    def __init__(self, width: int = 3) -> None:
        super().__init__()
        self.linear = nn.Linear(1, width)
        self.config = {"width": width}


def test_a_users_own_networks_are_saved_and_need_their_class_to_come_back(tmp_path: Path) -> None:
    loss = OwnLoss(OwnEncoder())
    loss.target_encoder_params.data.apply_(lambda value: value.fill_(3.0))
    path = save_pretrained(loss, tmp_path / "own")
    loaded = load_pretrained(path)
    assert (loaded.method, loaded.projector) == ("OwnLoss", None)
    assert all_equal(loaded.encoder.state_dict(), loss.encoder.module.state_dict())
    assert all((value == 3.0).all() for value in loaded.target_encoder.state_dict().values())
    assert torch.equal(loaded.rest["head.weight"], loss.head.weight)
    del loss.encoder.module.config
    with pytest.raises(PretrainedError, match=r"OwnEncoder without a `\.config`"):
        save_pretrained(loss, tmp_path / "other")
    in_another_process = f"from crptpro.pretrained import load_pretrained\nload_pretrained({str(path)!r})"
    refused = subprocess.run([sys.executable, "-c", in_another_process], capture_output=True, text=True)
    assert "is a 'OwnEncoder', which is not registered. Call crptpro.modules.register_network" in refused.stderr
    with pytest.raises(ValueError, match="PixelEncoder is a network of crptpro; give your class another name"):
        register_network(type("PixelEncoder", (nn.Module,), {}))


class Margin(LossModule):
    """A loss with options, of which it keeps one under another name."""

    def __init__(self, encoder: nn.Module, scale: float = 2.0, margin: float = 1.0, widths: Any = (1, 2)) -> None:
        super().__init__()
        self.convert_to_functional(encoder, "network")
        self.__dict__["encoder"] = encoder
        self.scale, self._margin, self.widths = scale, margin, widths


def test_an_option_of_a_users_loss_that_cannot_be_read_back_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = save_pretrained(Margin(OwnEncoder(), scale=3.0, margin=0.2, widths=(3,)), tmp_path / "own")
    assert "margin, widths of Margin: not recorded, so fine-tuning takes the default" in caplog.text
    assert load_pretrained(path).card["loss"]["config"] == {"scale": 3.0}
    caplog.clear()
    save_pretrained(make_loss(), tmp_path / "ours")
    assert not caplog.text


def test_an_encoder_that_its_loss_did_not_train_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(PretrainedError, match="has none of its parameters, so it was not trained with it"):
        save_pretrained(copy.deepcopy(Margin(OwnEncoder())), tmp_path / "own")
    save_pretrained(copy.deepcopy(make_loss()), tmp_path / "ours")
    frozen = copy.deepcopy(Margin(OwnEncoder()))
    frozen.encoder.requires_grad_(False)  # a loss may train heads on it
    save_pretrained(frozen, tmp_path / "own")

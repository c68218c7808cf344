"""Every pre-training method through the loop and the artifact, on two tiny domains."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from pretrain_world import SETTINGS, SIZE, same_state
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import LossModule

from crptpro.modules import SkillHead
from crptpro.objectives import get_method, method_defaults
from crptpro.pretrained import finetune, load_pretrained, rebuild_loss, save_pretrained
from crptpro.training import pretrain
from crptpro.training.pretrain.learner import Learner

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

SKILLS = 3
OPTIONS: dict[str, dict[str, Any]] = {
    "atc": {"latent_dim": 8, "hidden_dim": 16},
    "apt-c": {"latent_dim": 8, "temperature": 0.2},
    "proto-rl-c": {"num_prototypes": 8, "latent_dim": 8, "hidden_dim": 16},
    "becl": {"skill_dim": SKILLS, "hidden_dim": 16},
}
METHODS = pytest.mark.parametrize("name", list(OPTIONS))


def make(name: str, seed: int = 0, **options: Any) -> LossModule:
    torch.manual_seed(seed)
    method = get_method(name)
    small = {**method.encoder_options, "channels": (4, 4), "strides": (2, 1)}
    return method.build(
        replace(method, encoder_options=small).build_encoder(3, SIZE), **{**OPTIONS[name], **options}
    )


def make_buffer(domain: int, transitions: int = 60) -> ReplayBuffer:
    """Coarse colour patterns, which a shift leaves recognisable; the skill brightens them."""
    generator = torch.Generator().manual_seed(domain)
    pattern = torch.rand(transitions, 3, 2, 2, generator=generator).repeat_interleave(SIZE // 2, -1)
    skills = torch.arange(transitions) % SKILLS
    pixels = 120 * pattern.repeat_interleave(SIZE // 2, -2) + 60 * skills.view(-1, 1, 1, 1)
    pixels = pixels.to(torch.uint8)
    batch = {
        "pixels": pixels,
        "next": {"pixels": pixels.roll(1, -1)},
        "skill": F.one_hot(skills, SKILLS).float(),
    }
    buffer = ReplayBuffer(storage=LazyTensorStorage(transitions))
    buffer.extend(TensorDict(batch, [transitions]))
    return buffer


class World:
    """A domain that may interrupt the program."""

    def __init__(self, domain: int, interrupt_at: int | None = None) -> None:
        self.buffer = make_buffer(domain)
        self.samples, self.interrupt_at = 0, interrupt_at
        self.set_rng = self.buffer.set_rng

    def sample(self, batch_size: int) -> TensorDictBase:
        self.samples += 1
        if self.samples == self.interrupt_at:
            signal.raise_signal(signal.SIGINT)
        return self.buffer.sample(batch_size)


def worlds(interrupt_at: int | None = None) -> dict[str, World]:
    return {"dark": World(0), "bright": World(1, interrupt_at)}


def run(loss: LossModule, updates: int, datasets: Any = None, **options: Any) -> Any:
    return pretrain(loss, datasets or worlds(), updates=updates, **{**SETTINGS, **options})


@METHODS
def test_two_n_updates_equal_n_stop_and_resume_n(name: str, tmp_path: Path) -> None:
    whole, first, second = make(name), make(name), make(name)
    run(whole, 12)
    with pytest.raises(KeyboardInterrupt):
        run(first, 12, worlds(interrupt_at=3), run_dir=tmp_path)
    assert run(second, 12, run_dir=tmp_path).resumed_from == 6
    assert same_state(whole, second)
    assert not same_state(whole, make(name))


@METHODS
def test_training_lowers_the_loss(name: str) -> None:
    result = run(make(name), 240, log_interval=60, batch_size=16, learning_rate=3e-3)
    assert result.history[-1]["loss"] < 0.95 * result.history[0]["loss"]
    assert {"embedding_cosine", "cosine/dark", "cosine/bright"} <= set(result.metrics)


@METHODS
def test_bf16_trains_too_and_leaves_float32_behind(name: str) -> None:
    loss = make(name)
    result = run(loss, 3, precision="bf16")
    assert result.precision == "bf16"
    assert all(p.dtype == torch.float32 for p in loss.parameters())
    assert loss.encoder.compute_dtype == loss.projector.compute_dtype == torch.float32


@METHODS
def test_an_artifact_gives_the_loss_back_and_can_be_finetuned(name: str, tmp_path: Path) -> None:
    loss = make(name)
    run(loss, 5)
    saved = load_pretrained(save_pretrained(loss, tmp_path / "encoder"))
    assert saved.method == name
    assert (saved.target_encoder is not None) == (method_defaults(loss).encoder_tau is not None)
    rebuilt = rebuild_loss(saved)
    assert same_state(loss, rebuilt)
    assert all(p.requires_grad for p in rebuilt.parameters())
    batch = worlds()["dark"].sample(8)
    batch["pixels_view"] = batch["next", "pixels"]
    assert torch.equal(next(iter(rebuilt(batch).values())), next(iter(loss(batch).values())))
    tuned, result = finetune(saved, {"bright": World(1)}, updates=3, **SETTINGS)
    assert result.updates == 3
    assert tuned.method_name == name
    assert not same_state(tuned, rebuilt)


def test_becls_artifact_carries_its_whole_head_and_its_pixel_offset(tmp_path: Path) -> None:
    loss = make("becl")
    saved = load_pretrained(save_pretrained(loss, tmp_path / "encoder"), expect={"pixel_offset": 0.5})
    assert isinstance(saved.projector, SkillHead)
    features = loss.encoder(worlds()["dark"].sample(4)["pixels"])
    assert torch.equal(saved.projector(features), loss.projector(features))


def test_protorl_is_trained_by_the_comparison_alone(tmp_path: Path) -> None:
    result = run(make("proto-rl-c"), 4)
    assert result.metrics["loss_intr"] == 0
    assert result.metrics["loss"] == result.metrics["loss_comp"]
    saved = load_pretrained(save_pretrained(make("proto-rl-c"), tmp_path))
    assert rebuild_loss(saved).intr_loss_coef == 0


def test_the_view_of_a_loss_is_another_shift_of_the_same_images() -> None:
    seen: list[TensorDictBase] = []
    loss = make("apt-c")
    forward = loss.forward
    loss.forward = lambda batch: (seen.append(batch.clone()), forward(batch))[1]
    for augment in ("random_shift", "none"):
        run(loss, 1, augment=augment)
    assert [set(batch.keys()) for batch in seen] == [{"pixels", "pixels_view"}] * 2
    assert not torch.equal(seen[0]["pixels"], seen[0]["pixels_view"])
    assert torch.equal(seen[1]["pixels"], seen[1]["pixels_view"])
    means = [seen[0][key].float().mean(dim=(1, 2, 3)) for key in ("pixels", "pixels_view")]
    assert torch.corrcoef(torch.stack(means))[0, 1] > 0.9  # of the same row


def test_atcs_rate_warms_up_for_a_thousand_updates_and_ends_at_zero() -> None:
    loss = make("atc")
    defaults = method_defaults(loss)
    learner = Learner(
        loss, defaults, learning_rate=defaults.lr, encoder_tau=defaults.encoder_tau, updates=50_000
    )
    batch = worlds()["dark"].sample(4)
    expected = {
        0: 0.0,
        250: 2.5e-4,
        999: 9.99e-4,
        1_000: 1e-3,
        13_250: 8.5355339e-4,
        25_500: 5e-4,
        49_999: 1.0e-12,
    }
    for index, rate in expected.items():
        learner.update(batch, index=index, domain="dark")
        assert learner.optimizer.param_groups[0]["lr"] == pytest.approx(
            rate, rel=0.05 if rate < 1e-9 else 1e-6
        )


def test_atcs_first_update_changes_nothing_but_adams_moments() -> None:
    loss, untouched = make("atc"), make("atc")
    defaults = method_defaults(loss)
    learner = Learner(
        loss, defaults, learning_rate=defaults.lr, encoder_tau=defaults.encoder_tau, updates=50_000
    )
    learner.update(worlds()["dark"].sample(4), index=0, domain="dark")
    assert same_state(loss, untouched)
    assert all(state["exp_avg"].any() for state in learner.optimizer.state.values())
    before = loss.target_state()["encoder"]["convs.0.weight"].clone()
    learner.update(worlds()["dark"].sample(4), index=1_000, domain="dark")
    moved = loss.target_state()["encoder"]["convs.0.weight"] - before
    torch.testing.assert_close(
        moved, 0.01 * (loss.encoder.convs[0].weight.detach() - before), atol=1e-7, rtol=1e-3
    )


@pytest.mark.parametrize("name", ["apt-c", "becl"])
def test_methods_without_targets_have_no_target_rate(name: str) -> None:
    loss = make(name)
    assert method_defaults(loss).encoder_tau is None
    run(loss, 2)
    assert loss.training_record["settings"]["encoder_tau"] is None

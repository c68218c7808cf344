"""What pre-training refuses, and what it does with numbers that are none."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from pretrain_world import (
    SIZE,
    Spy,
    make_dataset,
    make_loss,
    run,
    same_state,
)
from tensordict import TensorDictBase

from crptpro.errors import DatasetError, NonFiniteError
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss, SimCLRLoss
from crptpro.training import pretrain
from crptpro.training.pretrain import learner


def test_a_nan_loss_is_named_and_the_last_checkpoint_kept(tmp_path: Path) -> None:
    class Poisoned(Spy):
        poison = False

        def sample(self, batch_size: int) -> TensorDictBase:
            batch = super().sample(batch_size)
            if self.poison and len(self.order) == 8:
                batch.set("pixels", torch.full(batch["pixels"].shape, math.nan))
            return batch

    spy = Poisoned("walker", make_dataset(0), [])
    spy.poison = True
    with pytest.raises(NonFiniteError, match=r"Update 8 on domain 'walker': loss_comp is nan"):
        run(loss := make_loss(), 20, [spy], run_dir=tmp_path)
    assert all(torch.isfinite(p).all() for p in loss.parameters())
    healthy, whole = make_loss(), make_loss()
    assert run(healthy, 20, [Poisoned("walker", make_dataset(0), [])], run_dir=tmp_path).resumed_from == 5
    run(whole, 20, [Poisoned("walker", make_dataset(0), [])])
    assert same_state(healthy, whole)


def test_on_a_gpu_the_first_bad_update_is_named_at_the_next_check(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = learner.Learner._watch

    def deferred(self: learner.Learner, *arguments: Any) -> None:
        self.is_deferred = True
        watch(self, *arguments)

    class Poisoned(Spy):
        def sample(self, batch_size: int) -> TensorDictBase:
            batch = super().sample(batch_size)
            if len(self.order) >= 6:
                batch.set("pixels", torch.full(batch["pixels"].shape, math.nan))
            return batch

    monkeypatch.setattr(learner.Learner, "_watch", deferred)
    spy = Poisoned("walker", make_dataset(0), [])
    with pytest.raises(NonFiniteError, match=r"Update 6: loss_comp is not finite"):
        run(make_loss(), 20, [spy], log_interval=8)
    assert len(spy.order) == 8


def test_a_nan_gradient_is_never_checkpointed(tmp_path: Path) -> None:
    loss = make_loss()
    loss.projector.linear.bias.register_hook(lambda gradient: gradient * math.nan)
    with pytest.raises(NonFiniteError, match=r"After update 1 the parameter projector_params.linear.bias"):
        run(loss, 20, run_dir=tmp_path, checkpoint_interval=1)
    assert run(make_loss(), 1, run_dir=tmp_path).resumed_from == 0


@pytest.mark.parametrize(
    ("datasets", "error", "message"),
    [
        ([], DatasetError, "at least one dataset"),
        ([object()], DatasetError, "without `sample"),
        (["/nowhere/at/all"], DatasetError, "/nowhere/at/all"),
    ],
)
def test_unusable_datasets_are_named(datasets: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        pretrain(make_loss(), datasets, updates=1, progress=False)


def test_a_missing_entry_is_named_with_its_dataset() -> None:
    class Blind(Spy):
        def sample(self, batch_size: int) -> TensorDictBase:
            return super().sample(batch_size).exclude(("next", "pixels"))

    with pytest.raises(DatasetError, match=r"\('next', 'pixels'\), which the dataset 'walker' lacks"):
        run(make_loss(), 1, [Blind("walker", make_dataset(0), [])])


def test_two_datasets_of_one_domain_get_two_names() -> None:
    result = run(make_loss(), 4, [Spy("walker", make_dataset(i), []) for i in range(2)])
    assert {"cosine/walker", "cosine/walker_2"} <= set(result.metrics)


def test_outputs_that_come_and_go_are_refused(tmp_path: Path) -> None:
    class Moody(ProtoLoss):
        drops: str | None = None
        calls = 0

        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            out = super().forward(tensordict)
            self.calls += 1
            if self.calls == 3 and self.drops is None:
                out["loss_extra"] = torch.full((), torch.nan)
            return out if self.drops is None or self.calls < 3 else out.exclude(self.drops)

    for drops, message in (
        (None, "returned loss_extra at update 3"),
        ("assignment_entropy", "did not return assignment_entropy at update 3"),
    ):
        encoder = PixelEncoder(3, channels=(4,), strides=(2,), image_size=SIZE)
        loss = Moody(encoder, num_prototypes=8, latent_dim=8, hidden_dim=16)
        loss.drops = drops
        with pytest.raises(ValueError, match=message):
            run(loss, 5)


def test_the_rate_of_targets_is_refused_where_there_are_none() -> None:
    loss = SimCLRLoss(PixelEncoder(3, channels=(4,), strides=(2,), image_size=SIZE), latent_dim=4)
    with pytest.raises(ValueError, match=r"`encoder_tau` 0\.5 is the rate of target networks"):
        run(loss, 2, encoder_tau=0.5)


def test_impossible_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="`updates` must be at least 1, got 0"):
        run(make_loss(), 0)
    with pytest.raises(ValueError, match="`augment` must be"):
        run(make_loss(), 1, augment="rotate")


def test_a_dataset_of_other_images_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    dataset = make_dataset(0)
    dataset.card = {"image_size": 84, "frame_stack": 3}
    with pytest.raises(DatasetError, match=r"3 images of 84 px; the encoder takes 1 of 16 px"):
        run(make_loss(), 2, {"dark": dataset}, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()

"""One update, what it is made of, and what a run leaves of itself."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from pretrain_world import (
    Spy,
    make_dataset,
    make_loss,
    record,
    run,
    same_state,
)
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule

from crptpro.modules import PixelEncoder
from crptpro.objectives import MethodDefaults, registry
from crptpro.training.pretrain import learner


def test_update_u_uses_dataset_u_mod_n() -> None:
    order: list[str] = []
    run(make_loss(), 7, [Spy(name, make_dataset(i), order) for i, name in enumerate("abc")])
    assert "".join(order) == "abcabca"


def test_one_update_equals_the_same_steps_by_hand() -> None:
    from torchrl.objectives import SoftUpdate

    from crptpro.seeding import derive_seed

    loss, twin = make_loss(), make_loss()
    run(loss, 1, {"only": make_dataset(0)}, augment="none")
    dataset = make_dataset(0)
    dataset.set_rng(torch.Generator().manual_seed(derive_seed(3, "pretrain", "sample", "only")))
    updater = SoftUpdate(twin, tau=0.05)
    optimizer = torch.optim.Adam(twin.parameters(), lr=1e-3, fused=True)
    out = twin.before_update()(dataset.sample(8).select("pixels", ("next", "pixels")))
    (out["loss_comp"] + out["loss_intr"]).backward()
    optimizer.step()
    updater.step()
    assert same_state(loss, twin)


def test_training_lowers_the_loss() -> None:
    result = run(make_loss(), 120, log_interval=10)
    assert result.history[-1]["loss_comp"] < result.history[0]["loss_comp"] - 0.1


class OwnLoss(LossModule):
    """A user's loss: no targets, no projector, no registration."""

    encoder: TensorDictModule
    encoder_params: Any
    target_encoder_params: Any

    def __init__(self, encoder: PixelEncoder) -> None:
        super().__init__()
        module = TensorDictModule(encoder, in_keys=["pixels"], out_keys=["features"])
        self.convert_to_functional(module, "encoder", create_target_params=False)
        self.head = nn.Linear(encoder.feature_dim, encoder.feature_dim)
        self.in_keys = ["pixels", ("next", "pixels")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        with self.encoder_params.to_module(self.encoder, preserve_module_state=False):
            now = self.encoder.module(tensordict["pixels"])
            after = self.encoder.module(tensordict["next", "pixels"])
        error = F.mse_loss(self.head(now), after.detach())
        return TensorDict({"loss_prediction": error, "feature_mean": now.detach().mean()}, [])


def test_a_users_own_loss_trains_resumes_and_is_logged(tmp_path: Path) -> None:
    def make() -> OwnLoss:
        torch.manual_seed(0)
        return OwnLoss(PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=16))

    whole, parts = make(), make()
    before = parts.head.weight.clone()
    run(whole, 10)
    run(make(), 5, run_dir=tmp_path)
    result = run(parts, 10, run_dir=tmp_path)
    assert same_state(whole, parts)
    assert not torch.equal(parts.head.weight, before)
    assert {"loss", "loss_prediction", "feature_mean", "cosine/dark", "cosine/bright"} <= set(result.metrics)
    assert result.collapse["ln_num_prototypes"] is None


def test_the_record_has_terms_diagnostics_and_prototype_metrics(tmp_path: Path) -> None:
    run(make_loss(), 8, run_dir=tmp_path)
    row = record(tmp_path)[-1]
    expected = {
        "updates", "loss", "loss_comp", "loss_intr", "comp", "intr", "assignment_entropy",
        "assignment_entropy_frac", "prototypes_in_use", "embedding_cosine", "cosine/dark", "cosine/bright",
        "loss/dark", "loss/bright", "prototype_ane", "prototype_kne_3", "prototype_kne_half",
        "prototype_dispersion", "ln_num_prototypes",
    }  # fmt: skip
    assert expected <= set(row)
    assert float(row["loss"]) == pytest.approx(float(row["loss_comp"]) + float(row["loss_intr"]))
    assert float(row["loss"]) == pytest.approx((float(row["loss/dark"]) + float(row["loss/bright"])) / 2)
    mean = (float(row["cosine/dark"]) + float(row["cosine/bright"])) / 2
    assert float(row["embedding_cosine"]) == pytest.approx(mean)
    assert math.isclose(float(row["ln_num_prototypes"]), math.log(8))


def test_a_dead_run_is_announced_and_written_into_the_training_record(
    caplog: pytest.LogCaptureFixture,
) -> None:
    loss = make_loss()
    with torch.no_grad():
        loss.projector.linear.weight.zero_()
        loss.projector.linear.bias.fill_(1.0)
    loss.target_projector_params.data.update_(loss.projector_params.data)
    with caplog.at_level(logging.INFO, logger="crptpro"):
        result = run(loss, 12, learning_rate=1e-9, log_interval=2, patience_updates=6)
    assert result.is_dead
    assert loss.training_record["collapse"]["verdict"] == "dead"
    messages = [(r.levelname, r.message) for r in caplog.records]
    assert any(level == "INFO" and "plateau" in text for level, text in messages)
    assert any(level == "ERROR" and "DEAD RUN" in text for level, text in messages)


def test_without_a_run_directory_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(make_loss(), 5)
    assert result.run_dir is None
    assert result.history[-1]["updates"] == 5
    assert not list(tmp_path.iterdir())


def test_random_shift_changes_the_images_and_none_does_not() -> None:
    seen: list[torch.Tensor] = []

    class Watching(type(make_loss())):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            seen.append(torch.stack([tensordict["pixels"], tensordict["next", "pixels"].roll(-1, -1)]))
            return super().forward(tensordict)

    for augment in ("none", "random_shift"):
        torch.manual_seed(0)
        loss = Watching(
            PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=16), num_prototypes=8, latent_dim=8
        )
        run(loss, 1, [make_dataset(0)], augment=augment)
    assert torch.equal(seen[0][0], seen[0][1])
    assert seen[1].dtype == torch.uint8
    assert not torch.equal(seen[1][0], seen[1][1])
    assert not torch.equal(seen[0][0], seen[1][0])


def test_an_own_augmentation_gets_batch_and_generator() -> None:
    calls: list[Any] = []

    def invert(batch: TensorDictBase, generator: torch.Generator) -> TensorDictBase:
        calls.append(generator)
        return batch.set("pixels", 255 - batch["pixels"])

    run(make_loss(), 2, augment=invert)
    assert len(calls) == 2
    assert isinstance(calls[0], torch.Generator)


def test_warmup_and_clipping_of_a_method_are_applied(monkeypatch: pytest.MonkeyPatch) -> None:
    defaults = MethodDefaults(schedule="warmup_cosine", warmup_updates=2, grad_clip=1e-3, encoder_tau=None)
    monkeypatch.setattr(registry, "_METHODS", {})
    registry.register_method("scheduled", type(make_loss()), defaults)
    rates, norms = [], []
    step = torch.optim.Adam.step

    def watch(self: torch.optim.Adam, *arguments: Any) -> Any:
        group = self.param_groups[0]
        rates.append(group["lr"])
        norms.append(math.sqrt(sum(float(p.grad.square().sum()) for p in group["params"])))
        return step(self, *arguments)

    monkeypatch.setattr(torch.optim.Adam, "step", watch)
    loss = make_loss()
    before = {
        name: state["convs.0.weight"].clone()
        for name, state in loss.target_state().items()
        if name == "encoder"
    }
    run(loss, 6)
    assert rates == pytest.approx([1e-3 * learner.warmup_cosine(i, 2, 6) for i in range(6)])
    assert rates[0] == 0.0
    assert max(norms) == pytest.approx(1e-3, rel=1e-3)
    assert torch.equal(loss.target_state()["encoder"]["convs.0.weight"], before["encoder"])


def test_targets_that_differ_from_their_sources_are_kept_at_the_start() -> None:
    loss = make_loss()
    weight = loss.target_encoder_params["convs", "0", "weight"]
    weight.data.fill_(2.0)
    run(loss, 1, learning_rate=1e-12)
    expected = 0.95 * 2.0 + 0.05 * loss.encoder.convs[0].weight.detach()
    assert torch.allclose(weight, expected, atol=1e-6)


def test_bf16_is_used_while_training_and_gone_afterwards() -> None:
    dtypes = []
    loss = make_loss()
    loss.encoder.register_forward_hook(lambda module, inputs, output: dtypes.append(output.dtype))
    result = run(loss, 2, precision="bf16")
    assert result.precision == "bf16"
    assert set(dtypes) == {torch.bfloat16}
    assert loss.encoder.compute_dtype == torch.float32
    assert loss.encoder.convs[0].weight.dtype == torch.float32

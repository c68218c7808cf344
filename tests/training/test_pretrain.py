from __future__ import annotations

import csv
import logging
import math
import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from pretrain_world import SETTINGS, SIZE, make_dataset, make_datasets, make_loss, same_state
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule

from crptpro.errors import CheckpointError, DatasetError, NonFiniteError
from crptpro.loggers import RunLogger
from crptpro.modules import PixelEncoder
from crptpro.objectives import ATCLoss, MethodDefaults, ProtoLoss, SimCLRLoss, registry
from crptpro.pretrained import finetune, save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training import pretrain
from crptpro.training.pretrain import learner
from crptpro.training.pretrain import run as pretrain_run

TIMED = {"unix_time_s", "updates_per_s", "resident_bytes"}


def run(loss: LossModule, updates: int, datasets: Any = None, **options: Any) -> Any:
    return pretrain(loss, datasets or make_datasets(), updates=updates, **{**SETTINGS, **options})


def record(run_dir: Path) -> list[dict[str, str]]:
    with open(run_dir / "pretrain.csv") as file:
        return [{k: v for k, v in row.items() if k not in TIMED} for row in csv.DictReader(file)]


class Spy:
    """Notes the order in which datasets are sampled."""

    def __init__(self, name: str, dataset: Any, order: list[str]) -> None:
        self.name, self.dataset, self.order = name, dataset, order
        self.domain = name

    def sample(self, batch_size: int) -> TensorDictBase:
        self.order.append(self.name)
        return self.dataset.sample(batch_size)

    def set_rng(self, generator: torch.Generator) -> None:
        self.dataset.set_rng(generator)


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


def test_two_n_updates_equal_n_stop_and_resume_n(tmp_path: Path) -> None:
    whole, first, second = make_loss(), make_loss(), make_loss()
    run(whole, 22, run_dir=tmp_path / "whole")
    run(first, 11, run_dir=tmp_path / "parts")
    result = run(second, 22, run_dir=tmp_path / "parts")
    assert result.resumed_from == 11
    assert same_state(whole, second)
    assert not same_state(whole, first)
    assert record(tmp_path / "whole") == record(tmp_path / "parts")
    assert [int(row["updates"]) for row in record(tmp_path / "parts")] == [4, 8, 12, 16, 20, 22]


@pytest.mark.parametrize("begun_in", ["fp32", "bf16"])
def test_a_run_goes_on_in_the_arithmetic_that_it_began_in_on_a_machine_with_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun_in: str
) -> None:
    whole, second = make_loss(), make_loss()
    run(whole, 8, precision=begun_in)
    monkeypatch.setattr("crptpro.modules.precision._is_cpu_faster_in_bf16", lambda: begun_in == "bf16")
    assert run(make_loss(), 4, run_dir=tmp_path, precision="auto").precision == begun_in
    monkeypatch.setattr("crptpro.modules.precision._is_cpu_faster_in_bf16", lambda: begun_in != "bf16")
    assert run(second, 8, run_dir=tmp_path, precision="auto").precision == begun_in
    assert same_state(whole, second)
    other = "bf16" if begun_in == "fp32" else "fp32"
    with pytest.raises(CheckpointError, match=f"precision was '{begun_in}', now '{other}'"):
        run(make_loss(), 8, run_dir=tmp_path, precision=other)


def test_seeds_make_runs_equal_or_different_and_leave_the_global_generator_alone() -> None:
    losses = [make_loss() for _ in range(3)]
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    for loss, seed in zip(losses, (0, 0, 1)):
        run(loss, 3, seed=seed)
    assert torch.equal(torch.rand(1), expected)
    assert same_state(losses[0], losses[1])
    assert not same_state(losses[0], losses[2])


@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
def test_killed_at_random_moments_it_completes_with_the_same_weights_and_record(
    tmp_path: Path, stage: str
) -> None:
    script = Path(__file__).with_name("kill_target.py")
    command = [sys.executable, str(script), stage, str(tmp_path / "killed"), "160", "1"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    output = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=environment, check=False
    )
    assert output.returncode == 0, output.stderr
    assert int(output.stdout.splitlines()[-1]) >= 3  # kills
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if stage == "pretrain":
            whole = make_loss()
            run(whole, 160, run_dir=tmp_path / "whole")
        else:
            start = save_pretrained(make_loss(), tmp_path / "start")
            whole, _ = finetune(start, make_dataset(1), updates=160, run_dir=tmp_path / "whole", **SETTINGS)
    finally:
        torch.set_num_threads(threads)
    save_pretrained(whole, tmp_path / "whole" / "encoder")
    weights = [tmp_path / run / "encoder" / "weights.safetensors" for run in ("killed", "whole")]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    assert record(tmp_path / "killed") == record(tmp_path / "whole")


def test_a_finished_run_started_again_does_nothing_and_says_the_same(tmp_path: Path) -> None:
    first = run(make_loss(), 8, run_dir=tmp_path)
    again = run(loss := make_loss(), 8, run_dir=tmp_path)
    assert (again.updates, again.resumed_from, again.history) == (8, 8, [])
    assert again.metrics["loss_comp"] == pytest.approx(first.metrics["loss_comp"])
    assert again.collapse == first.collapse
    assert loss.training_record["updates"] == 8


def test_the_training_record_names_the_versions_that_trained_not_those_that_looked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = make_loss()
    run(first, 6, run_dir=tmp_path)
    monkeypatch.setattr(pretrain_run, "provenance", lambda: {"versions": {"torch": "later"}})
    again, further = make_loss(), make_loss()
    run(again, 6, run_dir=tmp_path)
    assert again.training_record["made_with"] == first.training_record["made_with"]
    run(further, 8, run_dir=tmp_path)
    assert further.training_record["made_with"]["versions"] == {"torch": "later"}


def test_ctrl_c_writes_a_checkpoint_between_two_updates(tmp_path: Path) -> None:
    class Interrupting(Spy):
        def sample(self, batch_size: int) -> TensorDictBase:
            if len(self.order) == 6:
                signal.raise_signal(signal.SIGINT)
            return super().sample(batch_size)

    order: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        run(make_loss(), 20, [Interrupting("a", make_dataset(0), order)], run_dir=tmp_path)
    second, whole = make_loss(), make_loss()
    assert run(second, 20, [Spy("a", make_dataset(0), [])], run_dir=tmp_path).resumed_from == 7
    run(whole, 20, [Spy("a", make_dataset(0), [])])
    assert same_state(second, whole)


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    run(make_loss(), 5, run_dir=tmp_path)
    with pytest.raises(CheckpointError, match="batch_size was 8, now 4"):
        run(make_loss(), 10, run_dir=tmp_path, batch_size=4)
    with pytest.raises(CheckpointError, match=r"learning_rate was 0\.001, now 0\.01"):
        run(make_loss(), 10, run_dir=tmp_path, learning_rate=0.01)
    with pytest.raises(CheckpointError, match=r"loss\.temperature was 0\.1, now 0\.2"):
        run(make_loss(temperature=0.2), 10, run_dir=tmp_path)
    with pytest.raises(CheckpointError, match=r"shape of prototypes_params\.weight was 'float32\[8, 8\]'"):
        run(make_loss(num_prototypes=16), 10, run_dir=tmp_path)
    datasets = {"dark": make_dataset(0, transitions=50), "bright": make_dataset(1)}
    with pytest.raises(CheckpointError, match=r"datasets\[0\]\.transitions was 60, now 50"):
        run(make_loss(), 10, datasets, run_dir=tmp_path)
    with pytest.raises(CheckpointError, match="has done 5 updates, 3 are asked"):
        run(make_loss(), 3, run_dir=tmp_path)
    with pytest.raises(CheckpointError, match="already holds a run"):
        run(make_loss(), 10, run_dir=tmp_path, resume=False)


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


def test_a_finished_run_started_again_judges_its_last_row_by_that_rows_cosine(tmp_path: Path) -> None:
    class Late(ATCLoss):
        """Its embeddings are all alike from the twelfth update on."""

        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            self.register_buffer("count", torch.zeros(()))

        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            out = super().forward(tensordict)
            self.count += 1
            out["embedding_cosine"] = (self.count > 11).float()
            return out

    def once() -> Any:
        loss = Late(PixelEncoder(3, channels=(4,), strides=(2,), image_size=SIZE), latent_dim=4, hidden_dim=8)
        return run(loss, 15, run_dir=tmp_path, log_interval=11, patience_updates=8)

    first, again = once(), once()
    assert first.collapse["cosine"] == {"dark": 1.0, "bright": 1.0}
    assert again.collapse == first.collapse


def test_without_a_run_directory_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(make_loss(), 5)
    assert result.run_dir is None
    assert result.history[-1]["updates"] == 5
    assert not list(tmp_path.iterdir())


def test_a_given_logger_gets_the_rows_and_other_streams_survive_a_resume(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        run(make_loss(), 6, run_dir=tmp_path, logger=logger)
        logger.log({"return": 1.0}, stream="eval", env_steps=10)
        run(make_loss(), 12, run_dir=tmp_path, logger=logger)
        assert [row["updates"] for row in logger.rows("pretrain")] == [4, 8, 12]
        assert len(logger.rows("eval")) == 1


def test_rows_of_an_attempt_without_a_checkpoint_are_taken_back(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"loss": 1.0}, stream="pretrain", updates=4)
    run(make_loss(), 4, run_dir=tmp_path)
    assert [row["updates"] for row in record(tmp_path)] == ["4"]


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


def draws() -> tuple[float, float, float]:
    """One of each global generator."""
    return random.random(), float(np.random.rand()), float(torch.rand(()))  # noqa: NPY002


def test_the_callers_generators_are_left_as_they_were_when_a_run_is_continued(tmp_path: Path) -> None:
    run(make_loss(), 4, run_dir=tmp_path)
    loss = make_loss()
    seed_everything(5)
    expected = draws()
    seed_everything(5)
    run(loss, 8, run_dir=tmp_path)
    assert draws() == expected


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

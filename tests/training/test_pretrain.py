"""Pre-training on datasets: what an update does, that a run continues, what is refused, what the record holds."""

from __future__ import annotations

import dataclasses
import itertools
import math
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose
from torchrl.objectives import LossModule
from toy_env import random_episode, record, write_dataset
from toy_runs import SIZE, make_dataset, make_datasets, make_encoder, make_loss, pretend_cpu, same_state

from crptpro.data import FrameDataset
from crptpro.errors import CheckpointError, CRPTproError, DatasetError
from crptpro.objectives import ATCLoss, ProtoLoss, SimCLRLoss, get_method
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import PretrainConfig, PretrainResult, Run, finetune, pretrain
from crptpro.training.pretrain import make_optimizer
from crptpro.transforms import RandomShift

SETTINGS = PretrainConfig(
    batch_size=8, learning_rate=1e-3, seed=3, log_interval=4, checkpoint_interval=5, precision="fp32"
)


def run(loss: LossModule, updates: int, run_dir: Path | None = None, **options: Any) -> PretrainResult:
    datasets = options.pop("datasets", None) or make_datasets()
    config = options.pop("config", SETTINGS)
    return pretrain(loss, datasets, updates=updates, run_dir=run_dir, config=config, progress=False, **options)


class Brightness(LossModule):
    """A loss of one's own without targets or heads: predict the mean brightness of an image."""

    in_keys = ("pixels",)
    out_keys = ("loss_brightness",)

    def __init__(self) -> None:
        super().__init__()
        self.encoder = make_encoder()
        self.head = nn.Linear(self.encoder.feature_dim, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        target = tensordict["pixels"].float().mean((1, 2, 3)).unsqueeze(1) / 255
        return TensorDict({"loss_brightness": (self.head(self.encoder(tensordict["pixels"])) - target).square().mean()})


class Headed(nn.Module):
    """An encoder of one's own around the library's."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.feature_dim = make_encoder(), 6
        self.head = nn.Linear(self.encoder.feature_dim, 6)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.head(self.encoder(pixels))


def watched(loss: LossModule) -> list[TensorDictBase]:
    """The batches that a loss is given, as they come."""
    batches: list[TensorDictBase] = []
    loss.register_forward_pre_hook(lambda _, inputs: batches.append(inputs[0].clone()))
    return batches


def test_domains_take_turns() -> None:
    batches = watched(loss := Brightness())
    run(loss, 5)
    assert [bool(batch["pixels"].float().mean() > 0.4 * 255) for batch in batches] == [False, True, False, True, False]


def test_a_loss_is_given_what_it_reads_and_nothing_else() -> None:
    """A recorded update needs batches of one shape, and domains have actions of their own."""
    batches = watched(loss := Brightness())
    run(loss, 2, datasets=[make_dataset(domain, action_dim=6 * (domain + 1)) for domain in range(2)])
    shapes = [{key: value.shape for key, value in batch.items(True, True)} for batch in batches]
    assert shapes == [{"pixels": (8, 3, SIZE, SIZE)}] * 2


def test_an_update_is_one_adam_step_and_one_ema_step_of_the_targets() -> None:
    loss = make_loss()
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    run(loss, 1)
    moved = loss.state_dict()
    weight = next(name for name in moved if name.startswith("encoder_params") and name.endswith("weight"))
    target = f"target_{weight}"
    step = moved[weight] - before[weight]
    # Adam's first step has the size of the learning rate wherever there is a gradient.
    torch.testing.assert_close(step.abs().max(), torch.tensor(1e-3), rtol=1e-3, atol=0)
    torch.testing.assert_close(moved[target], before[target] + 0.05 * (moved[weight] - before[target]))


def test_training_lowers_the_loss_and_the_record_says_so(tmp_path: Path) -> None:
    result = run(make_loss(), 60, tmp_path)
    rows = record(tmp_path / "pretrain.csv")
    assert [int(row["updates"]) for row in rows] == list(range(4, 64, 4))
    assert float(rows[-1]["loss_comp"]) < float(rows[0]["loss_comp"])
    assert {"loss", "loss/dark", "loss/bright", "cosine/dark", "cosine/bright", "prototype_kne_3"} <= {*rows[0]}
    assert float(rows[0]["ln_num_prototypes"]) == pytest.approx(math.log(8))
    assert result.metrics["loss"] == pytest.approx(float(rows[-1]["loss"]))
    assert (result.updates, result.resumed_from, result.collapse["verdict"]) == (60, 0, "learning")


@pytest.mark.parametrize("make", [make_loss, get_method("atc").build, SimCLRLoss])
def test_a_resumed_run_gives_the_weights_and_the_record_of_an_uninterrupted_one(tmp_path: Path, make: Any) -> None:
    def build() -> LossModule:
        torch.manual_seed(0)
        return make() if make is make_loss else make(make_encoder(), latent_dim=8)

    whole, parts = build(), build()
    run(whole, 14, tmp_path / "whole", warmup_updates=3)
    updates = itertools.count(1)
    parts.register_forward_hook(lambda *_: signal.raise_signal(signal.SIGINT) if next(updates) == 7 else None)
    with pytest.raises(KeyboardInterrupt):
        run(parts, 14, tmp_path / "parts", warmup_updates=3)
    resumed = build()
    result = run(resumed, 14, tmp_path / "parts", warmup_updates=3)
    assert result.resumed_from == 7
    assert same_state(resumed, whole)
    assert record(tmp_path / "parts" / "pretrain.csv") == record(tmp_path / "whole" / "pretrain.csv")


def test_a_larger_budget_extends_a_finished_run_and_the_same_one_gives_its_result_again(tmp_path: Path) -> None:
    whole = run(make_loss(), 14, tmp_path / "whole")
    for updates in (6, 14, 14):
        result = run(make_loss(), updates, tmp_path / "parts")
    assert same_state(result.loss, whole.loss)
    assert (result.updates, result.metrics["loss"]) == (14, whole.metrics["loss"])
    rows = record(tmp_path / "parts" / "pretrain.csv")
    assert rows == record(tmp_path / "whole" / "pretrain.csv")
    assert [row["updates"] for row in rows] == ["4", "8", "12", "14"]


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("proto-rl-c", r"proto-rl-c explores its domains .* use pretrain_active"),
        ("crptpro-finetune", "crptpro-finetune takes a trained encoder of crptpro"),
        ("crptpro-no-bonus", "crptpro-no-bonus takes a trained encoder of crptpro"),
    ],
)
def test_a_method_that_does_not_begin_with_datasets_is_refused(method: str, message: str) -> None:
    with pytest.raises(CRPTproError, match=message):
        pretrain(make_loss(), make_datasets(), method=method, progress=False)
    built = get_method(method).build(make_encoder(), num_prototypes=8, latent_dim=8)
    with pytest.raises(CRPTproError, match=message):
        pretrain(built, make_datasets(), progress=False)


def test_the_card_of_a_loss_built_by_hand_names_no_method_that_explores(tmp_path: Path) -> None:
    result = run(SimCLRLoss(make_encoder(), latent_dim=8), 1)
    assert result.method == load_pretrained(save_pretrained(result, tmp_path)).method == "SimCLRLoss"


def test_finetuning_takes_the_updates_of_the_method_of_that_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = load_pretrained(save_pretrained(run(make_loss(), 1), tmp_path))
    dataset, samples = make_dataset(0), itertools.count()
    sample = dataset.sample
    dataset.sample = lambda *a, **k: (next(samples) and signal.raise_signal(signal.SIGINT)) or sample(*a, **k)
    with caplog.at_level("WARNING", logger="crptpro"), pytest.raises(KeyboardInterrupt):
        finetune(before, dataset, batch_size=8, progress=False)
    assert "of 2,000 updates" in caplog.text


def test_finetuning_for_no_update_is_refused_as_pre_training_is(tmp_path: Path) -> None:
    before = load_pretrained(save_pretrained(run(make_loss(), 1), tmp_path))
    with pytest.raises(ValueError, match="`updates` must be at least 1, got 0"):
        finetune(before, make_dataset(0), updates=0, progress=False)


def test_a_run_is_not_continued_on_another_kind_of_device(tmp_path: Path) -> None:
    require_same = Run.require_same
    with pytest.MonkeyPatch.context() as patch:  # as a run on a GPU
        patch.setattr(Run, "require_same", lambda self, named: require_same(self, {**named, "device": "cuda"}))
        run(make_loss(), 4, tmp_path)
    with pytest.raises(CheckpointError, match="device was 'cuda', now 'cpu'"):
        run(make_loss(), 8, tmp_path)


def test_a_schedule_over_the_run_cannot_be_extended(tmp_path: Path) -> None:
    run(ATCLoss(make_encoder(), latent_dim=8), 4, tmp_path, method="atc")
    with pytest.raises(CheckpointError, match="updates was 4, now 8"):
        run(ATCLoss(make_encoder(), latent_dim=8), 8, tmp_path, method="atc")


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"config": dataclasses.replace(SETTINGS, seed=4)}, "seed was 3, now 4"),
        ({"datasets": {"dark": make_dataset(0)}}, "datasets"),
        ({"loss": lambda: make_loss(num_prototypes=16)}, "shape of"),
    ],
)
def test_a_run_of_other_settings_is_refused_by_name(tmp_path: Path, changed: dict[str, Any], named: str) -> None:
    run(make_loss(), 4, tmp_path)
    loss = changed.pop("loss", make_loss)()
    with pytest.raises(CheckpointError, match=named):
        run(loss, 6, tmp_path, **changed)


class Slope(LossModule):
    """A loss whose gradient is constant, so that a step of Adam is the learning rate."""

    in_keys, out_keys = ("pixels",), ("loss_slope",)

    def __init__(self, slope: float = 1.0) -> None:
        super().__init__()
        self.layer, self.slope = nn.Linear(1, 1, bias=False), slope
        self.seen: list[float] = []

    def forward(self, tensordict: Any) -> TensorDict:
        self.seen.append(self.layer.weight.item())
        return TensorDict({"loss_slope": self.slope * self.layer.weight.sum()})


def test_a_run_follows_the_learning_rate_and_the_clipping_of_its_method() -> None:
    loss = Slope(1000.0)
    run(loss, 6, method="atc", learning_rate=1.0, warmup_updates=2)
    steps = -torch.tensor([*loss.seen, loss.layer.weight.item()]).diff()
    torch.testing.assert_close(steps, torch.tensor([0.0, 0.5, 1.0, 0.853553, 0.5, 0.146447]), rtol=1e-4, atol=1e-5)
    assert loss.layer.weight.grad.norm() == pytest.approx(10)


def test_loading_keeps_the_learning_rate_that_a_recorded_update_reads() -> None:
    loss, method = make_loss(), get_method("atc")
    saved = make_optimizer(loss, method, cuda_graph=False)[0].state_dict()
    optimizer = make_optimizer(loss, method, cuda_graph=True)[0]
    rate = optimizer.param_groups[0]["lr"]
    saved["param_groups"][0]["lr"] = torch.tensor(0.5)
    optimizer.load_state_dict(saved)
    assert optimizer.param_groups[0]["lr"] is rate
    assert rate.item() == 0.5
    assert optimizer.param_groups[0]["capturable"]  # as it was built, whatever the saved one was


def test_prototypes_are_scaled_to_unit_length_before_an_update() -> None:
    loss = make_loss()
    loss.prototypes.weight.data.mul_(3)
    run(loss, 1, learning_rate=1e-9)
    torch.testing.assert_close(loss.prototypes.weight.detach().norm(dim=1), torch.ones(8), rtol=1e-5, atol=1e-5)


def pointed() -> ReplayBuffer:
    """Images of one bright point each, at a place of its own."""
    pixels = torch.zeros(60, 3, SIZE, SIZE, dtype=torch.uint8)
    for i in range(60):
        pixels[i, :, 5 + i % 6, 5 + i // 6 % 6] = 100 + i
    buffer = ReplayBuffer(storage=LazyTensorStorage(60))
    buffer.extend(TensorDict({"pixels": pixels, "next": {"pixels": pixels + 100}}, [60]))
    return buffer


def shifts(images: torch.Tensor) -> tuple[torch.Tensor, list]:
    value = images[:, 0].flatten(1).max(1).values.long()
    place = images[:, 0].flatten(1).argmax(1)
    index = value - 100
    return index, list(zip((place // SIZE - (5 + index % 6)).tolist(), (place % SIZE - (5 + index // 6 % 6)).tolist()))


def test_both_views_are_of_one_image_under_shifts_of_up_to_four_pixels() -> None:
    batches = watched(loss := SimCLRLoss(make_encoder(), latent_dim=8))
    run(loss, 1, datasets=pointed(), batch_size=600)
    (one, first), (two, second) = (shifts(batches[0][key]) for key in ("pixels", "pixels_view"))
    assert torch.equal(one, two)
    for found in (first, second):
        assert {row for row, _ in found} == {column for _, column in found} == set(range(-4, 5))
    assert sum(a == b for a, b in zip(first, second)) < 30


class Masked(Brightness):
    """Reads further entries than images."""

    in_keys = ("pixels", ("next", "pixels"), "mask", "volume", "row")


def test_only_images_are_shifted() -> None:
    buffer = make_dataset(0)
    pixels = buffer[:]["pixels"]
    batches = watched(loss := Masked())
    volume = torch.rand(60, 2, 4, 4)
    other = ReplayBuffer(storage=LazyTensorStorage(60))
    other.extend(buffer[:].update({"mask": pixels[:, :1], "volume": volume, "row": torch.arange(60)}))
    run(loss, 1, datasets=other)
    batch = batches[0]
    assert torch.equal(batch["mask"], pixels[batch["row"], :1])
    assert torch.equal(batch["volume"], volume[batch["row"]])
    assert not torch.equal(batch["pixels"], pixels[batch["row"]])


def test_a_dataset_that_shifts_its_images_itself_is_refused() -> None:
    buffer = make_dataset(0)
    buffer.append_transform(RandomShift(in_keys=["pixels"], out_keys=["view"]))
    run(Brightness(), 1, datasets={"dark": buffer})
    buffer.append_transform(Compose(RandomShift(in_keys=["pixels"])))
    with pytest.raises(DatasetError, match="'dark' shifts its images, as pretrain does: remove its RandomShift"):
        run(Brightness(), 1, datasets={"dark": buffer})


def test_every_dataset_has_a_name_of_its_own() -> None:
    datasets = [make_dataset(0) for _ in range(3)]
    for dataset, domain in zip(datasets, ("maze_2", "maze", "maze")):
        dataset.card = {"domain": domain}
    result = run(make_loss(), 3, datasets=datasets)
    assert {"loss/maze_2", "loss/maze", "loss/maze_2_2"} <= result.metrics.keys()


def test_a_loss_that_returns_a_tensor_is_told_what_to_return(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Brightness, "forward", lambda self, batch: self.head.weight.sum())
    with pytest.raises(ValueError, match="returned a Tensor; a TensorDict of `loss_"):
        run(Brightness(), 1)


def test_one_buffer_given_twice_and_names_unfit_for_columns_are_refused() -> None:
    dataset = make_dataset(0)
    with pytest.raises(DatasetError, match="Dataset 1 is given twice as one object"):
        run(Brightness(), 2, datasets=[dataset, dataset])
    with pytest.raises(DatasetError, match="'dark, fast' cannot name columns"):
        run(Brightness(), 2, datasets={"dark, fast": dataset})


def test_datasets_are_left_as_they_were() -> None:
    datasets = make_datasets()
    before = [len(buffer.transform) for buffer in datasets.values()]
    run(make_loss(), 2, datasets=datasets)
    assert [len(buffer.transform) for buffer in datasets.values()] == before


def test_a_dead_run_is_announced_by_name_of_the_plateau(caplog: pytest.LogCaptureFixture) -> None:
    loss = make_loss(temperature=1e6)  # every assignment and prediction is uniform
    with caplog.at_level("INFO", logger="crptpro"):
        result = run(loss, 12)
    assert result.collapse["verdict"] == "plateau"
    assert "at ln(M) = 2.0794" in caplog.text
    assert "encoder has not begun to learn" in caplog.text


def test_what_is_no_dataset_or_gpu_or_lacks_an_entry_is_refused() -> None:
    with pytest.raises(ValueError, match="`cuda_graph` needs a GPU, but `device` is 'cpu'"):
        run(make_loss(), 1, cuda_graph=True)
    with pytest.raises(DatasetError, match="at least one dataset"):
        pretrain(make_loss(), [], updates=2, progress=False)
    with pytest.raises(DatasetError, match="is a list; give a directory"):
        pretrain(make_loss(), [[1, 2]], updates=2, progress=False)
    buffer = ReplayBuffer(storage=LazyTensorStorage(4))
    buffer.extend(TensorDict({"pixels": torch.zeros(4, 3, 16, 16, dtype=torch.uint8)}, [4]))
    with pytest.raises(DatasetError, match=r"reads \('next', 'pixels'\), which the dataset 'x' lacks"):
        run(make_loss(), 2, datasets={"x": buffer})


def test_the_stacks_that_an_open_dataset_samples_must_fit_the_encoder_whatever_its_card_says(tmp_path: Path) -> None:
    path = write_dataset(tmp_path, [random_episode(20, size=SIZE)])
    for channels in (3, 12):  # a directory is opened for the encoder's stack
        assert run(make_loss(channels=channels), 2, datasets=path).updates == 2
    single = FrameDataset.open(path, frame_stack=1)
    assert run(make_loss(channels=3), 2, datasets=single).updates == 2
    with pytest.raises(DatasetError, match=r"shape \(3, 16, 16\); the encoder takes \(9, 16, 16\)\..*samples stacks"):
        run(make_loss(channels=9), 2, datasets=single)


def test_a_run_keeps_its_precision_on_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_cpu("amx_bf16", monkeypatch, tmp_path)
    run(make_loss(), 4, tmp_path / "run", precision="auto")
    pretend_cpu("", monkeypatch, tmp_path)
    assert run(make_loss(), 8, tmp_path / "run", precision="auto").training["settings"]["precision"] == "bf16"


def test_auto_is_float32_for_a_loss_or_an_encoder_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_cpu("amx_bf16", monkeypatch, tmp_path)
    assert run(Brightness(), 2, precision="auto").training["settings"]["precision"] == "fp32"
    with pytest.raises(RuntimeError, match="dtype"):  # its linear layer takes no bfloat16
        run(Brightness(), 2, precision="bf16")
    own = ProtoLoss(Headed(), num_prototypes=8, latent_dim=4, hidden_dim=8)
    assert run(own, 2, precision="auto").training["settings"]["precision"] == "fp32"
    assert run(make_loss(), 2, precision="auto").training["settings"]["precision"] == "bf16"


def test_bf16_stays_within_the_spread_of_two_fp32_seeds_and_ends_with_the_run() -> None:
    def curve(precision: Any, seed: int) -> torch.Tensor:
        config = PretrainConfig(batch_size=16, learning_rate=1e-3, seed=seed, log_interval=10, precision=precision)
        result = run(loss := make_loss(seed), 100, config=config)
        assert loss.encoder.compute_dtype == torch.float32
        assert result.training["settings"]["precision"] == precision
        return torch.tensor([row["loss_comp"] for row in result.history])

    reference, other_seed, fast = curve("fp32", 0), curve("fp32", 1), curve("bf16", 0)
    assert reference[-1] < reference[0] - 0.05  # it learns, so that there is something to differ in
    assert 0 < (fast - reference).abs().mean() < 0.1 * (other_seed - reference).abs().mean()

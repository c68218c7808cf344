"""Whose rows an update takes: one domain's after the other's, a random domain's, or all domains'."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import test_device_batches
import torch
from pretrain_world import SETTINGS, make_dataset, make_datasets, make_loss, same_state
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import LossModule

from crptpro.errors import CheckpointError, DatasetError
from crptpro.training import CollapseMonitor, pretrain
from crptpro.training.pretrain import loop
from crptpro.training.pretrain.turns import shares


class Spy:
    """Notes which domain is sampled, and how many rows."""

    def __init__(self, domain: int, calls: list[tuple[int, int]]) -> None:
        self.number, self.calls, self.buffer = domain, calls, make_dataset(domain)
        self.domain, self.set_rng = "abc"[domain], self.buffer.set_rng

    def sample(self, batch_size: int) -> TensorDictBase:
        self.calls.append((self.number, batch_size))
        return self.buffer.sample(batch_size)


def spies(calls: list[tuple[int, int]]) -> list[Spy]:
    return [Spy(domain, calls) for domain in range(3)]


def run(loss: LossModule, updates: int, datasets: Any = None, **options: Any) -> Any:
    return pretrain(loss, datasets or make_datasets(), updates=updates, **{**SETTINGS, **options})


def columns(run_dir: Path) -> set[str]:
    with open(run_dir / "pretrain.csv") as file:
        return set(next(csv.reader(file)))


@pytest.mark.parametrize("schedule", ["random", "mixed"])
def test_two_n_updates_equal_n_stop_and_resume_n(tmp_path: Path, schedule: Any) -> None:
    whole, first, second, cyclic = (make_loss() for _ in range(4))
    expected = run(whole, 22, domain_schedule=schedule, run_dir=tmp_path / "whole")
    run(first, 11, domain_schedule=schedule, run_dir=tmp_path / "parts")
    result = run(second, 22, domain_schedule=schedule, run_dir=tmp_path / "parts")
    assert result.resumed_from == 11
    assert same_state(whole, second)
    assert result.collapse == expected.collapse
    run(cyclic, 22)
    assert not same_state(whole, cyclic)


def test_cycle_is_what_there_was_and_another_schedule_is_refused_by_name(tmp_path: Path) -> None:
    loss, same = make_loss(), make_loss()
    run(loss, 5, run_dir=tmp_path / "cycle")
    run(same, 5, domain_schedule="cycle")
    assert same_state(loss, same)
    # Runs from before there was a choice can be continued.
    assert "domain_schedule" not in loss.training_record["settings"]
    with pytest.raises(CheckpointError, match="domain_schedule was 'absent', now 'mixed'"):
        run(make_loss(), 8, domain_schedule="mixed", run_dir=tmp_path / "cycle")
    run(drawn := make_loss(), 5, domain_schedule="random", run_dir=tmp_path / "random")
    assert drawn.training_record["settings"]["domain_schedule"] == "random"
    with pytest.raises(CheckpointError, match="domain_schedule was 'random', now 'absent'"):
        run(make_loss(), 8, run_dir=tmp_path / "random")


def test_random_draws_every_domain_alike_and_the_same_for_the_same_seed(tmp_path: Path) -> None:
    drawn = []
    for seed in (0, 0, 1):
        calls: list[tuple[int, int]] = []
        result = run(make_loss(), 120, spies(calls), domain_schedule="random", seed=seed, log_interval=60)
        drawn.append([domain for domain, _ in calls])
        assert {"loss/a", "loss/b", "loss/c", "cosine/a", "cosine/b", "cosine/c"} <= set(result.metrics)
    assert drawn[0] == drawn[1] != drawn[2]
    assert all(25 <= drawn[0].count(domain) <= 55 for domain in range(3))
    pairs = set(zip(drawn[0], drawn[0][1:]))
    assert len(pairs) == 9  # no order in which they come


def test_mixed_batches_have_rows_of_every_dataset(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[TensorDictBase] = []
    loss_class = type(make_loss())
    forward = loss_class.forward

    def watch(self: Any, batch: TensorDictBase) -> TensorDictBase:
        seen.append(batch.clone())
        return forward(self, batch)

    monkeypatch.setattr(loss_class, "forward", watch)
    calls: list[tuple[int, int]] = []
    run(make_loss(), 2, spies(calls), domain_schedule="mixed", augment="none")
    assert calls == [(0, 3), (1, 3), (2, 2)] * 2
    assert [batch.shape for batch in seen] == [torch.Size([8])] * 2
    for batch in seen:
        assert batch["pixels"].shape == batch["next", "pixels"].shape == (8, 3, 16, 16)
        brightness = batch["pixels"].float().mean((1, 2, 3))  # 60 more from a domain to the next
        assert ((brightness - 60) / 60).round().tolist() == [0, 0, 0, 1, 1, 1, 2, 2]


@pytest.mark.parametrize(("batch_size", "rows"), [(3, [1, 1, 1]), (512, [171, 171, 170]), (10, [4, 3, 3])])
def test_a_batch_is_split_as_evenly_as_it_can_be(batch_size: int, rows: list[int]) -> None:
    assert shares(batch_size, 3) == rows


def test_a_mixed_record_has_no_columns_of_domains_and_collapse_is_watched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched: list[Any] = []
    observe = CollapseMonitor.observe

    def watch(self: CollapseMonitor, updates: int, **values: Any) -> Any:
        watched.append(values["cosine"])
        return observe(self, updates, **values)

    monkeypatch.setattr(CollapseMonitor, "observe", watch)
    result = run(make_loss(), 8, domain_schedule="mixed", run_dir=tmp_path)
    assert not [name for name in columns(tmp_path) if "/" in name]
    assert [list(cosine) for cosine in watched] == [["all"], ["all"]]
    assert watched[-1]["all"] == pytest.approx(result.metrics["embedding_cosine"])
    assert result.collapse["cosine"] == watched[-1]


def test_a_loss_without_a_cosine_is_probed_with_images_of_every_domain(tmp_path: Path) -> None:
    class Silent(type(make_loss())):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            return super().forward(tensordict).exclude("embedding_cosine")

    def build() -> LossModule:
        loss = make_loss()
        loss.__class__ = Silent
        return loss

    result = run(build(), 4, domain_schedule="mixed", run_dir=tmp_path)
    assert -1 <= result.collapse["cosine"]["all"] <= 1
    assert not [name for name in columns(tmp_path) if "/" in name]
    drawn = run(build(), 40, domain_schedule="random", log_interval=20)
    assert {"cosine/dark", "cosine/bright"} <= set(drawn.metrics)


def test_what_cannot_be_mixed_or_is_no_schedule_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    run_dir = tmp_path / "run"
    with pytest.raises(ValueError, match=r"at least the number of domains .* got 2 and 3"):
        run(make_loss(), 2, spies([]), domain_schedule="mixed", batch_size=2, run_dir=run_dir)
    with pytest.raises(
        ValueError, match="`domain_schedule` must be 'cycle', 'random' or 'mixed', got 'rand'"
    ):
        run(make_loss(), 2, domain_schedule="rand", run_dir=run_dir)
    assert not run_dir.exists()


def test_entries_of_different_shapes_are_named() -> None:
    class Acting(type(make_loss())):
        in_keys = ["pixels", ("next", "pixels"), "action"]  # noqa: RUF012

    datasets = make_datasets()
    wider = datasets["bright"].sample(60).exclude("index")
    wider["action"] = torch.zeros(60, 5)
    datasets["bright"] = ReplayBuffer(storage=LazyTensorStorage(60), batch_size=8)
    datasets["bright"].extend(wider)
    loss = make_loss()
    loss.__class__ = Acting
    with pytest.raises(DatasetError, match="entries action of 'dark' and 'bright' differ"):
        run(loss, 2, datasets, domain_schedule="mixed")


@pytest.mark.parametrize("schedule", ["random", "mixed"])
def test_runs_on_frames_of_a_device_continue_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, schedule: Any
) -> None:
    monkeypatch.setattr(loop, "_is_gpu", lambda device: True)
    monkeypatch.setattr(loop, "resolve_cuda_graph", lambda *arguments, **keywords: True)

    def train(updates: int, run_dir: Path | None = None) -> LossModule:
        loss = test_device_batches.make_loss()
        datasets = {name: test_device_batches.make_dataset(seed) for name, seed in (("a", 1), ("b", 2))}
        run(loss, updates, datasets, domain_schedule=schedule, run_dir=run_dir)
        return loss

    whole = train(12)
    # Mixed batches are made of what the datasets sample.
    assert ("batches" in whole.training_record["settings"]) is (schedule == "random")
    train(7, tmp_path)
    assert same_state(train(12, tmp_path), whole)

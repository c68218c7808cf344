"""What a pre-training may vary beside the paper's settings, and the encoders that it keeps on its way."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from pretrain_world import SETTINGS, make_dataset, make_datasets, make_loss, same_state
from torchrl.objectives import LossModule

from crptpro.errors import CheckpointError, PretrainedError
from crptpro.modules import PixelEncoder, is_channels_last
from crptpro.objectives import MethodDefaults, registry
from crptpro.pretrained import encoder_snapshots, finetune, load_pretrained, save_pretrained, snapshot_path
from crptpro.training import pretrain

ANNEALED = {"assignment_temperature": 0.02, "annealing_updates": 16}


def run(loss: LossModule, updates: int, **options: Any) -> Any:
    return pretrain(loss, make_datasets(), updates=updates, **{**SETTINGS, **options})


@pytest.fixture
def rates(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Learning rates of the optimiser's steps."""
    seen: list[float] = []
    step = torch.optim.Adam.step

    def watch(self: torch.optim.Adam, *arguments: Any) -> Any:
        seen.append(self.param_groups[0]["lr"])
        return step(self, *arguments)

    monkeypatch.setattr(torch.optim.Adam, "step", watch)
    return seen


@pytest.mark.parametrize(
    ("options", "training"), [(ANNEALED, {}), ({}, {"warmup_updates": 15})], ids=["annealing", "warm-up"]
)
def test_two_n_updates_equal_n_stop_and_resume_n(
    tmp_path: Path, options: dict[str, Any], training: dict[str, Any]
) -> None:
    whole, first, second, plain = (
        make_loss(**options),
        make_loss(**options),
        make_loss(**options),
        make_loss(),
    )
    run(whole, 22, **training)
    run(first, 11, run_dir=tmp_path, **training)
    assert run(second, 22, run_dir=tmp_path, **training).resumed_from == 11
    assert same_state(whole, second)
    run(plain, 22)
    assert not torch.equal(plain.encoder.convs[0].weight, whole.encoder.convs[0].weight)


def test_an_annealed_artifact_says_so_and_goes_on_where_it_was(tmp_path: Path) -> None:
    loss = make_loss(**ANNEALED)
    run(loss, 20)
    path = save_pretrained(loss, tmp_path / "encoder")
    config = json.loads((path / "card.json").read_text())["loss"]["config"]
    assert {name: config[name] for name in ANNEALED} == ANNEALED
    tuned, _ = finetune(path, make_dataset(1), updates=2, **SETTINGS)
    assert int(tuned.updates_begun) == 22


def test_annealing_is_the_same_in_an_update_that_is_recorded() -> None:
    from crptpro.objectives import method_defaults
    from crptpro.training.pretrain.learner import Learner

    learners = []
    for captures in (False, True):
        loss = make_loss(**ANNEALED).train()
        learner = Learner(
            loss, method_defaults(loss), learning_rate=1e-3, encoder_tau=0.05, updates=6, captures=captures
        )
        dataset = make_dataset(0)
        dataset.set_rng(torch.Generator().manual_seed(0))
        for index in range(6):
            learner.update(dataset.sample(8).select("pixels", ("next", "pixels")), index=index, domain="dark")
        learners.append(learner)
    assert same_state(learners[0].loss, learners[1].loss)


def test_the_rate_warms_up_and_stays(rates: list[float]) -> None:
    run(make_loss(), 6, warmup_updates=4)
    assert rates == [1e-3 * factor for factor in (0.0, 0.25, 0.5, 0.75, 1.0, 1.0)]


def test_without_a_warm_up_everything_is_as_it_was(tmp_path: Path, rates: list[float]) -> None:
    loss, same = make_loss(), make_loss()
    run(loss, 6, run_dir=tmp_path)
    run(same, 6, warmup_updates=0)
    assert set(rates) == {1e-3}
    assert same_state(loss, same)
    assert "warmup_updates" not in loss.training_record["settings"]
    run(make_loss(), 8, run_dir=tmp_path, warmup_updates=0)


def test_another_warm_up_is_refused_by_name_and_a_longer_run_is_not(tmp_path: Path) -> None:
    run(make_loss(), 6, run_dir=tmp_path, warmup_updates=4)
    for other in (None, 2):
        with pytest.raises(CheckpointError, match="warmup_updates was 4, now"):
            run(make_loss(), 8, run_dir=tmp_path, warmup_updates=other)
    assert run(make_loss(), 8, run_dir=tmp_path, warmup_updates=4).resumed_from == 6


def test_a_warm_up_can_take_the_place_of_a_methods_own(
    monkeypatch: pytest.MonkeyPatch, rates: list[float], tmp_path: Path
) -> None:
    monkeypatch.setattr(registry, "_METHODS", {})
    defaults = MethodDefaults(schedule="warmup_cosine", warmup_updates=2)
    registry.register_method("scheduled", type(make_loss()), defaults)
    run(make_loss(), 6, warmup_updates=0, run_dir=tmp_path)
    assert rates[0] == 1e-3
    assert rates[-1] < 1e-3
    with pytest.raises(CheckpointError, match="warmup_updates was 0, now 'absent'"):
        run(make_loss(), 6, run_dir=tmp_path)


@pytest.mark.parametrize("schedule", ["constant", "warmup_cosine"])
def test_an_encoder_kept_on_the_way_is_that_of_the_run_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, schedule: Any
) -> None:
    monkeypatch.setattr(registry, "_METHODS", {})
    registry.register_method("own", type(make_loss()), MethodDefaults(schedule=schedule))
    loss, alone = make_loss(), make_loss()
    run(loss, 12, at_updates=encoder_snapshots(tmp_path, (5, 12)))
    run(alone, 12)
    assert same_state(loss, alone)
    early, last = (load_pretrained(snapshot_path(tmp_path, done)) for done in (5, 12))
    assert early.card["training"]["updates"] == 5
    assert last.card["training"]["updates"] == 12
    assert torch.equal(last.encoder.convs[0].weight, loss.encoder.convs[0].weight)
    assert torch.equal(last.projector.linear.weight, loss.projector.linear.weight)
    if schedule == "constant":
        stopped = make_loss()
        run(stopped, 5)
        assert torch.equal(early.encoder.convs[0].weight, stopped.encoder.convs[0].weight)


def test_a_kept_encoder_has_what_reads_it_and_not_what_trains_on(tmp_path: Path) -> None:
    run(make_loss(), 4, at_updates=encoder_snapshots(tmp_path, (2,)))
    kept = load_pretrained(snapshot_path(tmp_path, 2))
    assert kept.projector is not None
    assert kept.prototypes is not None
    assert kept.predictor is kept.target_encoder is kept.target_projector is None
    with pytest.raises(PretrainedError, match="kept along a training"):
        finetune(kept, make_dataset(1), updates=1)


def test_a_run_that_broke_off_keeps_the_same_encoders(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run(make_loss(), 14, run_dir=whole, at_updates=encoder_snapshots(whole, (3, 12)))
    calls: list[int] = []

    def calling(done: int, *, breaks: bool) -> Any:
        def call(loss: LossModule) -> None:
            calls.append(done)
            encoder_snapshots(parts, (done,))[done](loss)
            if breaks:
                raise KeyboardInterrupt

        return call

    with pytest.raises(KeyboardInterrupt):  # its last checkpoint is at 10
        run(make_loss(), 14, run_dir=parts,
            at_updates={done: calling(done, breaks=done == 12) for done in (3, 12)})  # fmt: skip
    result = run(
        make_loss(), 14, run_dir=parts, at_updates={done: calling(done, breaks=False) for done in (3, 12)}
    )
    assert result.resumed_from == 10
    assert calls == [3, 12, 12]
    for done in (3, 12):
        one, two = (load_pretrained(snapshot_path(root, done)) for root in (whole, parts))
        assert one.identity() == two.identity()


@pytest.mark.parametrize("done", [0, 5])
def test_an_update_that_is_never_reached_is_refused(done: int) -> None:
    with pytest.raises(ValueError, match=f"`at_updates` must lie in 1 to `updates`, here 4, got {done}"):
        run(make_loss(), 4, at_updates={done: save_pretrained})


def test_the_layout_changes_rounding_only_is_recorded_and_is_left_as_it_was(tmp_path: Path) -> None:
    last, usual, other = make_loss(), make_loss(), make_loss()
    results = [run(last, 6), run(usual, 6, channels_last="off", run_dir=tmp_path), run(other, 6, seed=1)]
    first, second, of_seed_1 = (result.metrics["loss"] for result in results)
    assert abs(second - first) < 0.1 * abs(of_seed_1 - first)
    assert (last.training_record["channels_last"], usual.training_record["channels_last"]) == (True, False)
    assert is_channels_last(usual)
    # Runs from before the switch can be continued.
    assert "channels_last" not in last.training_record["settings"]
    with pytest.raises(CheckpointError, match="channels_last was False, now 'absent'"):
        run(make_loss(), 8, run_dir=tmp_path)
    assert run(make_loss(), 8, run_dir=tmp_path, channels_last="off").resumed_from == 6


def test_the_layout_is_in_force_while_a_loss_is_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []
    convolve = PixelEncoder._convolve

    def watch(self: PixelEncoder, images: torch.Tensor, parameters: Any) -> torch.Tensor:
        seen.append(convolve(self, images, parameters).is_contiguous(memory_format=torch.channels_last))
        return convolve(self, images, parameters)

    monkeypatch.setattr(PixelEncoder, "_convolve", watch)
    run(make_loss(), 1)
    run(make_loss(), 1, channels_last="off")
    half = len(seen) // 2
    assert all(seen[:half])
    assert not any(seen[half:])
    with pytest.raises(ValueError, match="`channels_last` must be 'auto', 'on' or 'off', got 'yes'"):
        run(make_loss(), 1, channels_last="yes")

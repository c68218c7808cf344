"""Fine-tuning that goes on with the Adam moments of the pre-training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from pretrain_world import SETTINGS, make_dataset, make_datasets, make_loss, same_state

from crptpro.errors import CheckpointError
from crptpro.pretrained import finetune, save_pretrained
from crptpro.training import pretrain
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.pretrain.moments import load_moments, read_moments


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A finished pre-training with its artifact."""
    loss = make_loss()
    pretrain(loss, make_datasets(), updates=9, run_dir=tmp_path / "run", **SETTINGS)
    save_pretrained(loss, tmp_path / "run" / "encoder")
    return tmp_path / "run"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Adam's state and settings at the first step of each run."""
    seen: list[dict[str, Any]] = []
    known: list[torch.optim.Optimizer] = []
    step = torch.optim.Adam.step

    def watch(self: torch.optim.Adam, *arguments: Any) -> Any:
        if not any(self is other for other in known):
            known.append(self)
            parameters = self.param_groups[0]["params"]
            state = [{k: v.clone() for k, v in self.state.get(p, {}).items()} for p in parameters]
            seen.append({"state": state, "lr": self.param_groups[0]["lr"]})
        return step(self, *arguments)

    monkeypatch.setattr(torch.optim.Adam, "step", watch)
    return seen


def tune(start: Path, updates: int = 6, **options: Any) -> Any:
    return finetune(start / "encoder", make_dataset(1), updates=updates, **{**SETTINGS, **options})


def test_moments_are_those_of_the_checkpoint_or_fresh(run_dir: Path, started: list[dict[str, Any]]) -> None:
    kept, _ = tune(run_dir, optimizer_state_from=run_dir, learning_rate=2e-3)
    fresh, _ = tune(run_dir, learning_rate=2e-3)
    saved = CheckpointDir(run_dir / "checkpoints").load_latest()["learner"]["optimizer"]["state"]
    assert len(started[0]["state"]) == len(saved) == 11
    for number, values in saved.items():
        assert values.keys() == {"step", "exp_avg", "exp_avg_sq"}
        assert values["step"] == 9
        assert all(torch.equal(started[0]["state"][number][name], value) for name, value in values.items())
    assert started[0]["lr"] == started[1]["lr"] == 2e-3  # not the pre-training's
    assert not any(started[1]["state"])
    assert not same_state(kept, fresh)
    assert kept.training_record["settings"]["optimizer_state"].startswith("kept ")
    assert "optimizer_state" not in fresh.training_record["settings"]


def test_moments_follow_the_layout_of_their_parameter() -> None:
    weight = torch.nn.Parameter(torch.zeros(4, 3, 2, 2).to(memory_format=torch.channels_last))
    optimizer = torch.optim.Adam([weight], fused=True)
    moment = torch.rand(4, 3, 2, 2)
    load_moments(
        optimizer, {0: {"step": torch.tensor(3.0), "exp_avg": moment, "exp_avg_sq": moment.square()}}
    )
    loaded = optimizer.state[weight]["exp_avg"]
    assert torch.equal(loaded, moment)
    assert loaded.stride() == weight.stride()


def test_going_on_with_the_same_data_is_going_on(run_dir: Path) -> None:
    """Only the draws of the batches differ from a pre-training that was extended: here there is one batch."""

    class One:
        def __init__(self) -> None:
            self.batch = make_dataset(0).sample(8)

        def set_rng(self, generator: torch.Generator) -> None:
            pass

        def sample(self, batch_size: int) -> Any:
            return self.batch.clone()

    torch.manual_seed(0)
    one, where = One(), run_dir.parent / "one"
    whole, first = make_loss(), make_loss()
    options = {**SETTINGS, "augment": "none"}
    pretrain(whole, one, updates=8, **options)
    pretrain(first, one, updates=5, run_dir=where, **options)
    save_pretrained(first, where / "encoder")
    tuned, _ = finetune(where / "encoder", one, updates=3, optimizer_state_from=where, **options)
    assert same_state(tuned, whole)


def test_two_n_updates_equal_n_stop_and_resume_n(run_dir: Path, tmp_path: Path) -> None:
    whole, _ = tune(run_dir, 12, optimizer_state_from=run_dir)
    tune(run_dir, 5, optimizer_state_from=run_dir, run_dir=tmp_path / "kept")
    parts, result = tune(run_dir, 12, optimizer_state_from=run_dir, run_dir=tmp_path / "kept")
    assert result.resumed_from == 5
    assert same_state(whole, parts)
    with pytest.raises(CheckpointError, match=r"optimizer_state was 'kept \w{16}', now 'absent'"):
        tune(run_dir, 12, run_dir=tmp_path / "kept")
    tune(run_dir, 5, run_dir=tmp_path / "fresh")
    assert tune(run_dir, 12, run_dir=tmp_path / "fresh")[1].resumed_from == 5
    with pytest.raises(CheckpointError, match=r"optimizer_state was 'absent', now 'kept"):
        tune(run_dir, 12, optimizer_state_from=run_dir, run_dir=tmp_path / "fresh")


def test_a_directory_without_the_moments_is_named_before_anything_is_written(
    run_dir: Path, tmp_path: Path
) -> None:
    absent, out = tmp_path / "absent", tmp_path / "out"
    with pytest.raises(CheckpointError, match=rf"{absent} is no run directory with checkpoints\. Name the"):
        tune(run_dir, optimizer_state_from=absent, run_dir=out)
    with pytest.raises(CheckpointError, match=rf"encoder is no run .* Did you mean {run_dir}\?"):
        tune(run_dir, optimizer_state_from=run_dir / "encoder", run_dir=out)
    CheckpointDir(tmp_path / "other" / "checkpoints").save({"learner": {"loss": {}}}, counter=1)
    with pytest.raises(CheckpointError, match=r"other are no pre-training's\. Name"):
        tune(run_dir, optimizer_state_from=tmp_path / "other", run_dir=out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"num_prototypes": 16},
            r"trained prototypes_params\.weight of shape \(16, 8\), now it has \(8, 8\)",
        ),
        ({"seed": 1}, r"ended with other weights .* \(first of them encoder_params\.convs\.0\.weight\)"),
    ],
)
def test_moments_of_other_parameters_or_weights_are_refused(
    run_dir: Path, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    other = tmp_path / "other"
    pretrain(make_loss(**options), make_datasets(), updates=2, run_dir=other, **SETTINGS)
    with pytest.raises(CheckpointError, match=rf"the run in {other} {message}\. .* fresh Adam"):
        tune(run_dir, optimizer_state_from=other)


def test_parameters_that_the_run_did_not_train_are_named(run_dir: Path) -> None:
    loss = make_loss()
    loss.head = torch.nn.Linear(2, 2)
    with pytest.raises(CheckpointError, match=r"did not train head\.weight, which is trained now"):
        read_moments(run_dir, loss)

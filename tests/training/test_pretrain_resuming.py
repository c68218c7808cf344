"""Pre-training that is stopped, killed, continued or asked for again."""

from __future__ import annotations

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
from pretrain_world import (
    SETTINGS,
    SIZE,
    Spy,
    make_dataset,
    make_loss,
    record,
    run,
    same_state,
)
from tensordict import TensorDictBase

from crptpro.errors import CheckpointError
from crptpro.loggers import RunLogger
from crptpro.modules import PixelEncoder
from crptpro.objectives import ATCLoss
from crptpro.pretrained import finetune, save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training.pretrain import run as pretrain_run


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

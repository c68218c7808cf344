"""Dense maps in bfloat16 for networks that compute in float32."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from test_downstream import SMALL, rows_without_time, small_pretrained, train
from test_downstream_parts import parts_of

from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import CheckpointError
from crptpro.training import downstream_parts
from crptpro.training.checkpoint import CheckpointDir
from crptpro.transforms import dense_shift_geometry

HALF: dict[str, Any] = {"precision": "fp32", "dense_precision": "bf16"}


@pytest.mark.parametrize(("dense_precision", "mode"), [("bf16", "dense"), ("auto", "reencode")])
def test_a_memory_too_small_for_float32_holds_bfloat16(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    dense_precision: str,
    mode: str,
) -> None:
    values = dense_shift_geometry(small_pretrained().encoder, 4).values
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: int(59 * values * 3 / 0.8))
    settings = {**HALF, "dense_precision": dense_precision, "env_steps": 10_000, "features": "auto"}
    with caplog.at_level("INFO", logger="crptpro"):
        parts = parts_of(small_pretrained(), tmp_path, **settings)
    assert parts.feature_mode == mode
    assert ("by dense_precision, it would fit" in caplog.text) is (mode == "reencode")
    if parts.features.cache is not None:
        assert parts.features.cache.dtype == torch.bfloat16
        assert parts.features.cache.features_dtype == parts.encoder.compute_dtype == torch.float32


def test_it_trains_the_agent_of_float32_maps_within_what_another_seed_changes(tmp_path: Path) -> None:
    # Adam turns the rounding of a gradient near zero into a whole step, so single weights differ by what the processor
    # makes of them; the losses of the run are what holds on any.
    def losses(name: str, **settings: Any) -> torch.Tensor:
        train(tmp_path / name, **settings)
        with (tmp_path / name / "train.csv").open(newline="") as file:
            return torch.tensor(
                [float(row["loss_qvalue"]) for row in csv.DictReader(file) if row["loss_qvalue"]]
            )

    whole, half, other = losses("fp32", precision="fp32"), losses("bf16", **HALF), losses("other", seed=1)
    assert len(whole) == len(half) == len(other) > 3
    assert 0 < (half - whole).abs().mean() < 0.1 * (other - whole).abs().mean()


def test_stopping_and_resuming_gives_the_numbers_of_an_uninterrupted_run(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", **HALF)
    train(tmp_path / "parts", **HALF, env_steps=60)
    resumed = train(tmp_path / "parts", **HALF)
    for key, value in whole.policy.actor.state_dict().items():
        assert torch.equal(resumed.policy.actor.state_dict()[key], value), key
    kept = [row for row in resumed.evaluations if row["env_steps"] != 60]
    assert rows_without_time(kept) == rows_without_time(whole.evaluations)


def test_a_run_goes_on_with_the_maps_that_it_began_with(tmp_path: Path) -> None:
    train(tmp_path, **HALF, env_steps=60)
    with pytest.raises(CheckpointError, match="dense_precision was 'bf16', now 'auto'"):
        train(tmp_path, precision="fp32")


def test_a_checkpoint_from_before_the_setting_existed_goes_on(tmp_path: Path) -> None:
    train(tmp_path, env_steps=60)
    checkpoints = CheckpointDir(tmp_path / "checkpoints")
    state = checkpoints.load_latest()
    assert state is not None
    assert state["fingerprint"].pop("dense_precision") == "auto"
    checkpoints.save(state, counter=state["counters"]["agent_steps"])
    assert train(tmp_path).env_steps == 120


def test_what_keeps_no_dense_maps_refuses_a_format_for_them() -> None:
    with pytest.raises(ValueError, match=r"`dense_precision`.*'fp16'"):
        dataclasses.replace(SMALL, dense_precision="fp16")
    for settings in ({"features": "reencode"}, {"algorithm": "drq", "intrinsic_reward_coef": 0.0}):
        with pytest.raises(ValueError, match="`dense_precision` is 'bf16', but neither"):
            DownstreamConfig(**settings, dense_precision="bf16")

"""The growth benchmark runs at a tiny size, prints its tables and writes its JSON."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from benchmarks.growth import Settings, main

from benchmarks import growth
from crptpro.errors import CRPTproError

TINY = Settings(
    domains=(1, 2), batch_sizes=(4, 8), prototypes=(16, 32), replay_transitions=(20, 30), workers=(1,), rounds=1,
    warmup=1, threads=torch.get_num_threads(), batch_size=8, image_size=16, dataset_transitions=20,
    collected_domain="pendulum", collected_transitions=4,
)  # fmt: skip


def test_what_grows_in_one_process_is_timed_by_its_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(dataclasses.replace(TINY, only=("domains", "batch", "prototypes", "replay"), out=tmp_path))
    results = json.loads((tmp_path / "growth.json").read_text())["results"]
    assert set(results) == {"domains", "batch", "prototypes", "replay"}
    assert list(results["domains"]["timings"]) == ["1", "2"]
    assert results["domains"]["times"]["1"] == 1
    assert set(results["batch"]) == {"pretrain", "downstream"}
    assert list(results["batch"]["downstream"]["timings"]) == ["4", "8"]
    assert set(results["prototypes"]) == {"pretrain", "bonus"}
    assert list(results["prototypes"]["bonus"]["timings"]) == ["16", "32"]
    small, large = (results["replay"][size] for size in ("20", "30"))
    assert set(small["timings"]) == {"encoding anew", "dense"}
    assert large["dense_gib"] > small["dense_gib"] > 0
    assert large["frames_gib"] > small["frames_gib"] > 0
    assert capsys.readouterr().out.count("\n|---") == 6


def test_dense_features_that_do_not_fit_are_left_out_and_said_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise CRPTproError("too little memory")

    monkeypatch.setattr(growth, "require_dense", refuse)
    results = main(dataclasses.replace(TINY, only=("replay",), replay_transitions=(20,), out=tmp_path))
    assert set(results["replay"]["20"]["timings"]) == {"encoding anew"}
    assert results["replay"]["20"]["no_dense"] == "too little memory"
    assert "| 20 | dense | does not fit |" in capsys.readouterr().out


@pytest.mark.gl
def test_workers_collect_on_the_simulator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = main(dataclasses.replace(TINY, only=("workers",), out=tmp_path))
    assert results["workers"]["1"]["whole"] > 0
    assert "| 1 |" in capsys.readouterr().out

"""The GPU benchmark runs through at a toy size without a GPU, and its floors are the published ones."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
import torch
from benchmarks.gpu import Settings, main
from benchmarks.gpu_checks import largest_difference
from benchmarks.gpu_updates import pretraining_floor
from benchmarks.library_updates import fresh_loss

from crptpro.errors import CRPTproError


def test_every_section_runs_prints_and_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = main(Settings(tiny=True, compile=False, out=tmp_path))
    written = json.loads((tmp_path / "gpu.json").read_text())
    assert written["settings"]["tiny"] is True
    assert set(written["results"]) == {"parity", "pretrain", "sustained", "downstream", "profile"}
    assert [check["passed"] for check in results["parity"]] == [True, True, True]
    assert set(results["pretrain"]["timings"]) == {
        "fp32", "TF32", "bf16", "bf16, recorded", "bf16, recorded, usual layout",
    }  # fmt: skip
    assert results["sustained"]["projected_s"] > 0
    printed = capsys.readouterr().out
    for words in ("pre-training, recorded", "50,000 of", "250,000 of", "All kernels:"):
        assert words in printed


def test_a_check_that_fails_ends_in_an_error_after_everything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    differences = itertools.cycle([1.0, 0.1])  # from the plain updates, and of those from themselves
    monkeypatch.setattr("benchmarks.gpu_checks.largest_difference", lambda one, two: next(differences))
    with pytest.raises(CRPTproError, match="Parity does not hold: pre-training, recorded; downstream"):
        main(Settings(only=("parity",), tiny=True, compile=False, out=tmp_path))
    assert (tmp_path / "gpu.json").exists()


def test_without_a_gpu_it_says_what_runs_anyway(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CRPTproError, match=r"No CUDA device here. `--tiny` runs"):
        main(Settings())


def test_the_floor_is_that_of_the_papers_shapes() -> None:
    floor = pretraining_floor(fresh_loss(), 512, element_bytes=2)
    assert floor["flop"] == pytest.approx(190.5e9, rel=1e-3)
    assert floor["bytes"] == pytest.approx(2.0e9, rel=0.1)
    assert pretraining_floor(fresh_loss(), 512, element_bytes=4)["bytes"] == pytest.approx(3.7e9, rel=0.1)


def test_a_weight_that_is_not_a_number_is_an_infinite_difference() -> None:
    one, two = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    assert largest_difference(one, one) == 0.0
    with torch.no_grad():
        two.bias[0] = torch.nan
    assert largest_difference(one, two) == torch.inf

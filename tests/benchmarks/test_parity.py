from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.synthetic import write_dataset

from benchmarks import parity


def test_three_runs_are_compared_and_written_down(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_dataset(tmp_path / "drifting", transitions=20, episode_transitions=10)
    settings = parity.Settings(
        (data,), updates=4, batch_size=4, num_prototypes=8, interval=2, out=tmp_path / "results"
    )
    parity.main(settings)
    results = json.loads((tmp_path / "results" / "parity.json").read_text())["results"]
    assert all(len(curve) == 2 for curve in results["curves"]["loss_comp"].values())
    near, far = results["fast against fp32, same seed"], results["fp32, two seeds"]
    assert 0 < near["loss_comp"] < far["loss_comp"]
    assert "| loss_comp |" in capsys.readouterr().out


def test_a_fast_path_that_goes_its_own_way_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = {
        "fast against fp32, same seed": {"loss_comp": 0.2, "embedding_cosine": 0.0},
        "fp32, two seeds": {"loss_comp": 0.1, "embedding_cosine": 0.1},
    }
    monkeypatch.setattr(parity, "measure", lambda settings: measured)
    with pytest.raises(SystemExit, match="1"):
        parity.main(parity.Settings(out=tmp_path))

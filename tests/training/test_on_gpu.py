"""What only a CUDA device can show: recorded and compiled updates against plain ones, runs that are continued."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from pretrain_world import SETTINGS
from test_device_batches import make_dataset, make_loss

from crptpro.data import FrameDataset
from crptpro.data.frame_storage import FrameStorage
from crptpro.objectives import ProtoLoss
from crptpro.training import pretrain

pytestmark = pytest.mark.gpu


def datasets_on_gpu() -> dict[str, FrameDataset]:
    found = {}
    for name, seed in (("a", 1), ("b", 2)):
        dataset = make_dataset(seed)
        storage = FrameStorage(dataset.frames.to("cuda"), dataset.transitions.to("cuda"))
        found[name] = FrameDataset(storage)
    return found


def train(updates: int = 12, **options: Any) -> tuple[ProtoLoss, Any]:
    loss = make_loss()
    settings = {**SETTINGS, "compile": "off", "cuda_graph": "off", **options}
    return loss, pretrain(loss, datasets_on_gpu(), updates=updates, device="cuda", **settings)


def assert_close(one: ProtoLoss, two: ProtoLoss, tolerance: float) -> None:
    """Within a few steps of the learning rate: Adam makes a step of the rounding of a gradient near zero."""
    for a, b in zip(one.parameters(), two.parameters()):
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    "switches", [{"cuda_graph": "on"}, {"compile": "on"}, {"cuda_graph": "on", "compile": "on"}]
)
def test_fast_pretraining_agrees_with_plain(switches: dict[str, str]) -> None:
    plain, expected = train()
    fast, found = train(**switches)
    assert fast.training_record["cuda_graph"] is ("cuda_graph" in switches)
    assert_close(plain, fast, 5e-3 if "compile" in switches else 2e-3)
    assert [row["loss"] for row in found.history] == pytest.approx(
        [row["loss"] for row in expected.history], abs=1e-2
    )


def test_a_recorded_run_is_continued_from_its_checkpoint(tmp_path: Path) -> None:
    whole, _ = train(cuda_graph="on")
    train(7, cuda_graph="on", run_dir=tmp_path)
    continued, result = train(cuda_graph="on", run_dir=tmp_path)
    assert result.resumed_from == 7
    assert_close(whole, continued, 2e-3)


def test_auto_neither_records_nor_compiles() -> None:
    loss, _ = train(6, compile="auto", cuda_graph="auto")
    assert not loss.training_record["compile"]
    assert not loss.training_record["cuda_graph"]

"""A device that this machine does not have ends every training in one line, before anything is written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder, usable_device
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import random_pretrained
from crptpro.training import pretrain, pretrain_active, train_downstream

UNUSABLE = ["abacus", *([] if torch.cuda.is_available() else ["cuda"])]


def loss() -> ProtoLoss:
    encoder = PixelEncoder(channels=(4,), strides=(2,), image_size=16)
    return ProtoLoss(encoder, num_prototypes=8, latent_dim=4, hidden_dim=8)


TRAININGS: dict[str, Callable[[str, Path], object]] = {
    "pretrain": lambda device, path: pretrain(loss(), path / "no data", device=device, run_dir=path / "run"),
    "pretrain_active": lambda device, path: pretrain_active(
        loss(), "walker", device=device, run_dir=path / "run"
    ),
    "train_downstream": lambda device, path: train_downstream(
        "walker_run", random_pretrained(), device=device, run_dir=path / "run"
    ),
}


@pytest.mark.parametrize("device", UNUSABLE)
@pytest.mark.parametrize("training", TRAININGS)
def test_a_device_that_is_not_there_is_named_and_nothing_is_written(
    training: str, device: str, tmp_path: Path
) -> None:
    with pytest.raises(CRPTproError, match=f"Device '{device}' cannot be used .*'cpu' always works"):
        TRAININGS[training](device, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_device_that_is_there_is_returned() -> None:
    assert usable_device("cpu") == torch.device("cpu")
    assert usable_device(torch.device("cpu")) == torch.device("cpu")

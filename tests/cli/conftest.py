from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from command import SIZE, Call, toy_dataset
from toy_env import FIXED

from crptpro import domains, plugins
from crptpro.cli import main
from crptpro.domains import register_domain
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import save_pretrained

collect_ignore = ["own_method.py", "slow_env.py", "conftest.py"]
"""What a test hands to the command must not have been imported by looking for doctests in it; nor may this file be,
under a name that another has."""


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """Run the command in this process, in ``tmp_path``; returns exit status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(domains, "_registered", {})
    monkeypatch.setattr(plugins, "_loaded", [])  # processes of later tests would load what these have loaded
    register_domain(FIXED)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crptpro", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as stopped:
            status = stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return toy_dataset(tmp_path / "data" / "toy")


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(image_size=SIZE), num_prototypes=16, latent_dim=4, hidden_dim=8)
    trained = SimpleNamespace(loss=loss, method="crptpro", training={"datasets": [{"domain": "toy"}]})
    return save_pretrained(trained, tmp_path / "encoder")

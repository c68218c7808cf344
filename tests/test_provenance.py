from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
import torch

from crptpro import provenance


def test_provenance_names_every_package_that_can_change_a_number() -> None:
    content = provenance.provenance()
    assert {"torch", "torchrl", "tensordict", "dm-control", "mujoco", "crptpro", "python"} <= set(content["versions"])
    assert "not installed" not in [content["versions"][p] for p in ("torch", "torchrl", "crptpro")]
    assert content["hardware"]["ram_bytes"] > 0
    json.dumps(content)


def test_hardware_names_the_instructions_that_torch_uses_and_what_is_wrong_with_a_gpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def name(index: int) -> str:
        if index == 1:
            raise RuntimeError("CUDA driver version is insufficient\nfor the runtime")
        return "Some GPU"

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", name)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    found = provenance.hardware.__wrapped__()
    assert found["cpu_instructions"] == "AVX512, AVX512-BF16"
    assert found["gpus"] == ["Some GPU", "unusable: CUDA driver version is insufficient"]


@pytest.mark.parametrize("is_tracked", [True, False])
def test_only_a_repository_that_tracks_this_package_names_its_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_tracked: bool
) -> None:
    package = tmp_path / ".venv" / "crptpro"
    package.mkdir(parents=True)
    (package / "provenance.py").write_text("")
    (tmp_path / "thesis.tex").write_text("x")
    if not is_tracked:
        (tmp_path / ".gitignore").write_text(".venv\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e@example.org"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "begin"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(provenance, "__file__", str(package / "provenance.py"))
    assert (provenance.git_revision.__wrapped__() != "unknown") is is_tracked

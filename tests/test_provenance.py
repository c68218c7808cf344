from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from crptpro import provenance


def test_provenance_names_every_package_that_can_change_a_number() -> None:
    content = provenance.provenance()
    assert {"torch", "torchrl", "tensordict", "dm-control", "mujoco", "crptpro", "python"} <= set(content["versions"])
    assert "not installed" not in [content["versions"][p] for p in ("torch", "torchrl", "crptpro")]
    assert content["hardware"]["ram_bytes"] > 0
    json.dumps(content)


def test_a_gpu_with_a_broken_driver_is_recorded_and_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def name(index: int) -> str:
        if index == 1:
            raise RuntimeError("CUDA driver version is insufficient\nfor the runtime")
        return "Some GPU"

    monkeypatch.setattr(provenance.torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(provenance.torch.cuda, "get_device_name", name)
    found = provenance.hardware.__wrapped__()
    assert found["gpus"] == ["Some GPU", "unusable: CUDA driver version is insufficient"]


@pytest.mark.parametrize(("bf16", "amx", "named"), [
    (False, False, "AVX512"), (True, False, "AVX512, AVX512-BF16"), (True, True, "AVX512, AVX512-BF16, AMX"),
])  # fmt: skip
def test_processors_of_one_name_are_told_apart_by_what_torch_computes_with(
    monkeypatch: pytest.MonkeyPatch, bf16: bool, amx: bool, named: str
) -> None:
    monkeypatch.setattr(provenance.torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(provenance.torch.cpu, "_is_avx512_bf16_supported", lambda: bf16)
    monkeypatch.setattr(provenance.torch.cpu, "_is_amx_tile_supported", lambda: amx)
    assert provenance.hardware.__wrapped__()["cpu_instructions"] == named


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

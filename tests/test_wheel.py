"""What an installed package contains beside its modules."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from crptpro.pretrained import load_pretrained, shipped_encoders

ROOT = Path(__file__).parents[1]
ACT = """
import json
import crptpro
from crptpro.envs import make_env
from crptpro.pretrained import load_pretrained, shipped_encoders
pixels = make_env("finger_spin", seed=0).reset()["pixels"]
loaded = {name: load_pretrained(name) for name in shipped_encoders()}
print(json.dumps([crptpro.__file__, {name: [each.identity(), each.encoder(pixels[None]).std().item()]
                                     for name, each in loaded.items()}]))
"""


@pytest.mark.gl
def test_a_wheel_brings_the_encoders_that_ship(tmp_path: Path) -> None:
    sources = tmp_path / "sources"  # building writes into them
    shutil.copytree(ROOT / "src", sources / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "wheel", str(sources), *options, "--wheel-dir", str(tmp_path)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([*pip, "install", *options[::2], "--target", str(tmp_path / "site"), str(wheel)], check=True)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    ran = subprocess.run(
        [sys.executable, "-c", ACT], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    place, found = json.loads(ran.stdout.splitlines()[-1])
    assert Path(place).is_relative_to(tmp_path / "site")
    assert list(found) == shipped_encoders()
    for name, (identity, spread) in found.items():
        assert identity == load_pretrained(name).identity()
        assert spread > 0

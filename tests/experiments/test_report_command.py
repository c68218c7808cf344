from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_reproduction import write_run

COMMAND = "import sys; from crptpro.cli import main; sys.argv[0] = 'crptpro'; main()"


def call(*arguments: object) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-c", COMMAND, "report", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)


def test_the_command_writes_the_page_and_says_where(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_run(tmp_path / f"run_{seed}", method="crptpro", task="walker_run", score=200 + seed, seed=seed)
    done = call(tmp_path, "--out", tmp_path / "page", "--replicates", 20, "--bootstrap-seed", 3)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(tmp_path / "page" / "index.html")
    assert "seed 3" in (tmp_path / "page" / "report.md").read_text()
    assert (tmp_path / "page" / "figures" / "runs-curves.svg").stat().st_size > 1000


@pytest.mark.parametrize(("arguments", "named"), [
    (("nowhere",), "There is no directory nowhere to report on"),
    ((".", "--replicates", "0"), "`replicates` must be at least 1"),
    ((".",), "holds nothing to report on"),
])  # fmt: skip
def test_a_refusal_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], named: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = call(*arguments)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert named in done.stderr

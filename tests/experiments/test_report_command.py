from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_reproduction import write_run

from crptpro.cli import main

COMMAND = "from crptpro.cli import main; main()"


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    library = logging.getLogger("crptpro")
    before = library.handlers[:], library.level, library.propagate
    yield
    library.handlers[:], library.propagate = before[0], before[2]
    library.setLevel(before[1])


def test_the_command_writes_the_page_and_says_where(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_run(tmp_path / f"run_{seed}", method="crptpro", task="walker_run", score=200 + seed, seed=seed)
    arguments = ["report", tmp_path, "--out", tmp_path / "page", "--replicates", 20, "--bootstrap-seed", 3]
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *map(str, arguments)],
        capture_output=True, text=True, timeout=120, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
    )  # fmt: skip
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
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    named: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["crptpro", "report", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    out, err = capsys.readouterr()
    assert (stopped.value.code, out) == (1, "")
    assert len(err.splitlines()) == 1
    assert named in err
    assert list(tmp_path.iterdir()) == []

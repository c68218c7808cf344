from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from original_agents import atc_state, save

from crptpro.cli import main
from crptpro.pretrained import load_pretrained


@pytest.fixture
def call(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., tuple[int, str]]]:
    """Run the command in this process; returns exit status and standard error."""
    library = logging.getLogger("crptpro")
    before = library.handlers[:], library.level, library.propagate

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["crptpro", *map(str, arguments)])
        try:
            main()
            status = 0
        except SystemExit as stopped:
            status = stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
        return status, capsys.readouterr().err

    yield run
    library.handlers[:], library.propagate = before[0], before[2]
    library.setLevel(before[1])


def test_import_and_export_are_commands(call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    snapshot = save(atc_state(), tmp_path / "params.pkl", is_legacy=True)
    status, told = call("import", snapshot, "--out", tmp_path / "encoder")
    assert status == 0
    assert "astooke/rlpyt" in told
    assert "left behind: optimizer" in told
    status, _ = call("export", tmp_path / "encoder", "--layout", "atc", "--out", tmp_path / "atc.pt")
    assert status == 0
    assert call("import", tmp_path / "atc.pt", "--out", tmp_path / "again", "--layout", "atc")[0] == 0
    one, two = (load_pretrained(tmp_path / name).card["weights_sha256"] for name in ("encoder", "again"))
    assert one == two


def test_trimming_is_a_command_that_says_what_it_saved(
    call: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    snapshot = save(atc_state(), tmp_path / "params.pkl", is_legacy=True)
    call("import", snapshot, "--out", tmp_path / "encoder")
    status, told = call("trim", tmp_path / "encoder", "--out", tmp_path / "trimmed")
    assert status == 0
    assert f"pretrained encoder: {tmp_path / 'trimmed'}, 0.0 MB of 0.0" in told  # a tiny one
    whole, trimmed = (load_pretrained(tmp_path / name) for name in ("encoder", "trimmed"))
    assert trimmed.identity() == whole.identity()
    assert trimmed.projector is None


def test_an_encoder_can_be_trimmed_from_inside_and_not_where_it_is(
    call: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = save(atc_state(), tmp_path / "params.pkl", is_legacy=True)
    call("import", snapshot, "--out", tmp_path / "encoder")
    monkeypatch.chdir(tmp_path / "encoder")
    status, told = call("trim", ".", "--out", "../trimmed")
    assert status == 0, told
    assert load_pretrained(tmp_path / "trimmed").identity() == load_pretrained("").identity()
    status, told = call("trim", ".", "--out", ".")
    assert status == 1
    assert told.startswith("error: . is the current directory or around it")
    assert told.count("\n") == 1
    assert load_pretrained(".").projector is not None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["encoder", "params.pkl", "trimmed"]


def test_a_refusal_is_one_line_and_status_one(call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    status, told = call("import", tmp_path / "notes.txt", "--out", tmp_path / "encoder")
    assert status == 1
    assert told.startswith("error: ")
    assert told.count("\n") == 1
    assert not (tmp_path / "encoder").exists()

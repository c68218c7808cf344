from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.huge_pages import Settings, main

from crptpro.errors import CRPTproError


def test_the_script_compares_updates_in_two_processes_and_writes_its_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    methods = ("atc", "becl")  # from a dataset, and on a batch of its own
    results = main(
        Settings(
            methods=methods,
            rounds=1,
            updates=1,
            batch_size=64,
            dataset_transitions=64,
            threads=1,
            out=tmp_path,
        )
    )
    told = capsys.readouterr().out
    for method in methods:
        without, with_them = results[method]["without"], results[method]["with"]
        assert with_them["wall_s"] > 0
        assert with_them["faults"] < without["faults"] or without["faults"] < 100
        assert f"| {method} | with |" in told
    assert set(json.loads((tmp_path / "huge_pages.json").read_text())["results"]) == set(methods)


def test_an_unknown_method_is_named(tmp_path: Path) -> None:
    with pytest.raises(CRPTproError, match="No updates of drq here"):
        main(Settings(methods=("drq",), out=tmp_path))

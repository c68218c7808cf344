"""The benchmark of the memory layouts."""

from __future__ import annotations

import json

from benchmarks.layouts import WAYS, Settings, main
from benchmarks.library_updates import precisions


def test_the_script_times_both_layouts_and_writes_its_results(tmp_path, capsys):
    results = main(Settings(batch_size=2, image_size=16, rounds=1, out=tmp_path))
    written = json.loads((tmp_path / "layouts.json").read_text())
    cases = {f"{name}, {work}" for name in precisions() for work in ("forward", "forward and backward")}
    assert set(results) == set(written["results"]) == cases
    assert all(set(timings) == set(WAYS) for timings in written["results"].values())
    assert capsys.readouterr().out.count("| channels last |") == len(cases)

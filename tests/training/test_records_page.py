"""The page on records explains every column that a run writes."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import test_downstream
import test_explore
import test_pretrain
from toy_runs import make_loss

PAGE = (Path(__file__).parents[2] / "docs" / "records.md").read_text()
EXPLAINED = {name.partition("/")[0] for name in re.findall(r"`([\w/<>]+)`", PAGE)}


def columns(run_dir: Path) -> set[str]:
    """The columns of all CSV files; ``x/cheetah`` is ``x`` of one domain."""
    return {name.partition("/")[0] for path in run_dir.glob("*.csv") for name in pd.read_csv(path).columns}


def test_every_column_is_explained(tmp_path: Path) -> None:
    test_pretrain.run(make_loss(), 8, tmp_path / "crptpro")
    for method in ("proto-rl-c", "apt-c", "becl"):
        test_explore.run(method, tmp_path / method)
    test_downstream.train(tmp_path / "task")
    for run_dir in tmp_path.iterdir():
        assert columns(run_dir) - EXPLAINED == set(), run_dir.name

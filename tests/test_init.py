"""Importing the package before PyTorch sets what PyTorch and OpenMP read once."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "THP_MEM_ALLOC_ENABLE")


@pytest.mark.parametrize(
    ("own", "spins"), [({}, "3000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "passive"}, "0")]
)
def test_threads_of_openmp_spin_briefly_unless_the_user_says_otherwise(own: dict[str, str], spins: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    code = "import os, crptpro, torch; print(os.environ['THP_MEM_ALLOC_ENABLE'])"
    ran = subprocess.run(
        [sys.executable, "-c", code], env={**environment, "OMP_DISPLAY_ENV": "verbose", **own}, capture_output=True,
        text=True, check=True,
    )  # fmt: skip
    assert f"GOMP_SPINCOUNT = '{spins}'" in ran.stderr
    assert ran.stdout.strip() == "1"

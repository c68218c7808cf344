from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from crptpro.seeding import derive_seed, global_rng_state, seed_everything, set_global_rng_state


def test_derived_seeds_fit_31_bits_and_differ_between_paths() -> None:
    seeds = {derive_seed(seed, name, i) for seed in range(5) for name in ("a", "b") for i in range(50)}
    assert len(seeds) == 500
    assert all(0 <= s < 2**31 for s in seeds)


def test_derived_seeds_are_the_same_in_another_process() -> None:
    code = "from crptpro.seeding import derive_seed; print(derive_seed(7, 'collect', 'walker', 3))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert int(other) == derive_seed(7, "collect", "walker", 3)


def test_a_name_and_a_number_that_print_alike_give_different_seeds() -> None:
    assert derive_seed(0, 1) != derive_seed(0, "1")
    assert derive_seed(0, "a", "b") != derive_seed(0, "ab")


def draw() -> tuple[float, float, float]:
    return random.gauss(0, 1), float(np.random.randn()), torch.rand(()).item()  # noqa: NPY002


def test_seed_everything_makes_three_generators_repeat() -> None:
    seed_everything(3)
    first = draw()
    seed_everything(3)
    assert draw() == first
    seed_everything(4)
    assert draw() != first


def test_the_states_of_three_generators_come_back_from_a_checkpoint(tmp_path: Path) -> None:
    draw()  # a Gaussian generator keeps its second number for the next call
    torch.save(global_rng_state(), tmp_path / "state.pt")
    numbers = [draw() for _ in range(3)]
    seed_everything(5)
    set_global_rng_state(torch.load(tmp_path / "state.pt", weights_only=True))
    assert [draw() for _ in range(3)] == numbers

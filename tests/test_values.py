from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from crptpro.values import as_float, as_int, as_path, check_numbers


@pytest.mark.parametrize(
    "value", [3, 3.0, np.int64(3), np.float32(3), np.array(3), torch.tensor(3), torch.tensor(3.0), np.longdouble(3)]
)
def test_a_number_of_any_library_is_taken_as_the_plain_number_it_means(value: Any) -> None:
    whole, real = as_int(value, "count"), as_float(value, "rate")
    assert (type(whole), whole, type(real), real) == (int, 3, float, 3.0)
    assert json.dumps([whole, real]) == "[3, 3.0]"


@pytest.mark.parametrize(
    "value",
    [
        2.5,
        "3",
        None,
        True,
        float("nan"),
        float("inf"),
        [3],
        np.array([3]),
        torch.ones(2),
        np.True_,
        torch.tensor(True),
        torch.tensor([True]),
        torch.tensor([3]),
    ],
)
def test_what_is_no_whole_number_is_refused_with_its_name_and_value(value: Any) -> None:
    with pytest.raises(ValueError, match="`transitions` must be a whole number, got"):
        as_int(value, "transitions")


@pytest.mark.parametrize("value", [
    "3", None, True, float("nan"), float("inf"), np.array([1.0, 2.0]), np.True_, torch.tensor(True),
    pytest.param(10**400, id="huge"),
])  # fmt: skip
def test_what_is_no_finite_number_is_refused_with_its_name_and_value(value: Any) -> None:
    with pytest.raises(ValueError, match="`rate` must be"):
        as_float(value, "rate")


@dataclass(frozen=True)
class Stage:
    updates: int | None = None
    tau: float | None = None
    seed: int = 0
    name: str = "a"

    def __post_init__(self) -> None:
        check_numbers(self, minima={}, maxima={"tau": 1})


def test_numbers_of_a_stage_are_plain_and_in_their_range_or_left_open() -> None:
    given: tuple[Any, ...] = (np.int64(3), torch.tensor(0.5), 7.0)
    assert repr(Stage(*given)) == "Stage(updates=3, tau=0.5, seed=7, name='a')"
    assert Stage() == Stage(None, None, 0)
    for wrong, message in (
        ({"updates": 0}, "`updates` must be at least 1, got 0"),
        ({"tau": 1.5}, r"`tau` must be at most 1, got 1\.5"),
        ({"tau": -1}, "`tau` must be at least 0, got -1"),
        ({"seed": -1}, "`seed` must be at least 0, got -1"),
        ({"seed": None}, "`seed` must be a whole number, got None"),
        ({"seed": 2**32}, "`seed` must be at most"),
    ):
        with pytest.raises(ValueError, match=message):
            Stage(**wrong)  # type: ignore[arg-type]


def test_a_path_is_expanded_and_one_that_no_record_can_hold_is_refused() -> None:
    assert as_path("~/runs") == Path.home() / "runs"
    assert as_path(Path("runs")) == Path("runs")
    assert as_path(b"abc") == Path("abc")  # type: ignore[arg-type]
    assert as_path("~nosuchuser/x") == Path("~nosuchuser/x")  # as a shell has it
    with pytest.raises(ValueError, match="`out` is empty"):
        as_path("", "out")
    with pytest.raises(ValueError, match="`out` is not UTF-8"):
        as_path("a\udcffb", "out")

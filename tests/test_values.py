from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from crptpro.values import as_float, as_int, as_path


@pytest.mark.parametrize(
    "value", [3, 3.0, np.int64(3), np.float32(3), np.array(3), torch.tensor(3), torch.tensor(3.0)]
)
def test_a_number_of_any_library_is_taken_as_the_plain_number_it_means(value: Any) -> None:
    whole, real = as_int(value, "count"), as_float(value, "rate")
    assert (type(whole), whole, type(real), real) == (int, 3, float, 3.0)
    assert json.dumps([whole, real]) == "[3, 3.0]"


@pytest.mark.parametrize(
    "value", [2.5, "3", None, True, float("nan"), float("inf"), [3], np.array([3]), torch.ones(2)]
)
def test_what_is_no_whole_number_is_refused_with_its_name_and_value(value: Any) -> None:
    with pytest.raises(ValueError, match="`transitions` must be a whole number, got"):
        as_int(value, "transitions")


@pytest.mark.parametrize("value", ["3", None, True, float("nan"), float("inf"), np.array([1.0, 2.0])])
def test_what_is_no_finite_number_is_refused_with_its_name_and_value(value: Any) -> None:
    with pytest.raises(ValueError, match="`rate` must be"):
        as_float(value, "rate")


def test_a_number_outside_its_range_is_refused() -> None:
    with pytest.raises(ValueError, match="`seed` must be at least 0, got -1"):
        as_int(-1, "seed", minimum=0)
    with pytest.raises(ValueError, match=r"`tau` must be at most 1, got 1\.5"):
        as_float(1.5, "tau", maximum=1)


def test_a_path_is_expanded_and_one_that_no_record_can_hold_is_refused() -> None:
    assert as_path("~/runs") == Path.home() / "runs"
    assert as_path(Path("runs")) == Path("runs")
    with pytest.raises(ValueError, match="`out` is empty"):
        as_path("", "out")
    with pytest.raises(ValueError, match="`out` is not UTF-8"):
        as_path("a\udcffb", "out")

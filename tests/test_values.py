from __future__ import annotations

import itertools
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from crptpro.training import PretrainConfig
from crptpro.values import as_float, as_int, as_path


@pytest.mark.parametrize(
    "value", [3, 3.0, np.int64(3), np.float32(3), np.array(3), torch.tensor(3), torch.tensor(3.0), np.longdouble(3)]
)
def test_a_number_of_any_library_is_taken_as_the_plain_number_it_means(value: Any) -> None:
    whole, real = as_int(value, "count"), as_float(value, "rate")
    assert (type(whole), whole, type(real), real) == (int, 3, float, 3.0)
    assert json.dumps([whole, real]) == "[3, 3.0]"


NO_NUMBERS = (
    "3", None, True, math.nan, math.inf, [3], np.array([3]), torch.ones(2), np.True_, torch.tensor(True),
    torch.tensor([True]), torch.tensor([3]),
)  # fmt: skip


@pytest.mark.parametrize(
    ("convert", "value"),
    [*itertools.product((as_int, as_float), NO_NUMBERS), (as_int, 2.5), pytest.param(as_float, 10**400, id="huge")],
)
def test_what_is_no_whole_or_finite_number_is_refused_with_its_name_and_value(convert: Any, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"`rate` must be .*, got {re.escape(repr(value))}\."):
        convert(value, "rate")


def test_settings_of_a_stage_are_plain_numbers_or_left_open() -> None:
    config = PretrainConfig(updates=np.int64(3), learning_rate=torch.tensor(0.5), seed=7.0)
    found = (config.updates, config.learning_rate, config.seed, config.warmup_updates)
    assert repr(found) == "(3, 0.5, 7, None)"


@pytest.mark.parametrize(("wrong", "message"), [
    ({"updates": 0}, "`updates` must be at least 1, got 0"),
    ({"encoder_tau": 1.5}, r"`encoder_tau` must be at most 1, got 1\.5"),
    ({"encoder_tau": -1}, "`encoder_tau` must be at least 0, got -1"),
    ({"seed": -1}, "`seed` must be at least 0, got -1"),
    ({"seed": None}, "`seed` must be a whole number, got None"),
    ({"seed": 2**32}, "`seed` must be at most"),
])  # fmt: skip
def test_a_setting_out_of_its_range_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PretrainConfig(**wrong)


def test_a_path_is_expanded_and_one_that_no_record_can_hold_is_refused() -> None:
    assert as_path("~/runs") == Path.home() / "runs"
    assert as_path(Path("runs")) == Path("runs")
    assert as_path(b"abc") == Path("abc")  # type: ignore[arg-type]
    assert as_path("~nosuchuser/x") == Path("~nosuchuser/x")  # as a shell has it
    with pytest.raises(ValueError, match="`out` is empty"):
        as_path("", "out")
    with pytest.raises(ValueError, match="`out` is not UTF-8"):
        as_path("a\udcffb", "out")
